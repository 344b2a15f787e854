"""``lio-jax sim``: write a simulated recording, native or as a ROS bag, with its truth."""

import shlex
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from lio_jax.commands.sim_options import ErrorOptions, Format, MotionOptions, SensorOptions
from lio_jax.core.errors import UsageError
from lio_jax.data.bag_writer import FORMAT_OF_ENDING, BagFormat, check_ending, write_bag
from lio_jax.data.native_writer import write_native
from lio_jax.data.sequence import LidarScan
from lio_jax.data.trajectory import Trajectory, write_tum
from lio_jax.data.whole_output import check_free, written_whole
from lio_jax.sim.gps import GpsModel
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.lidar import Lidar
from lio_jax.sim.sensors import find_sensor
from lio_jax.sim.sequence import SimulatedSequence

_DURATION = 60.0
"""Default duration, unless a trajectory sets it, s."""


def sim(
    world: str,
    sensor: str,
    duration: float | None,
    seed: int,
    out: Path,
    wanted: Format | None,
    overwrite: bool,
    motion: MotionOptions,
    sensors: SensorOptions,
    errors: ErrorOptions,
) -> None:
    """Simulate one recording from the command line."""
    of_ending: Mapping[str, Format] = FORMAT_OF_ENDING
    chosen = wanted or of_ending.get(out.suffix, "native")
    _check_output(out, chosen, overwrite)
    sequence = _sequence(world, sensor, duration, seed, motion, sensors, errors)
    began = time.perf_counter()
    scans = _with_progress(sequence)
    if chosen == "native":
        count = write_native(
            out,
            scans,
            name=sequence.info.name,
            sensor=sequence.info.sensor,
            T_imu_lidar=sequence.info.T_imu_lidar,
            imu=sequence.imu(),
            gps=sequence.gps(),
            truth=sequence.truth(),
            truth_arrays=sequence.truth_arrays(),
            overwrite=overwrite,
        )
    else:
        layout = find_sensor(sensor).layout
        count = _write_bag(sequence, scans, out, chosen, layout, overwrite)
    print(_summary(sequence, out, chosen, count / (time.perf_counter() - began)))


def truth_beside(bag: Path) -> tuple[Path, Path]:
    """Return the paths of a bag's truth: a TUM file for the poses, an .npz file for everything else."""
    stem = bag.stem if bag.suffix in FORMAT_OF_ENDING else bag.name
    return bag.with_name(f"{stem}.truth.tum"), bag.with_name(f"{stem}.truth.npz")


def _check_output(out: Path, chosen: Format, overwrite: bool) -> None:
    """Refuse an impossible output at once, not after a long simulation."""
    if chosen == "native":
        if out.suffix in FORMAT_OF_ENDING:
            raise UsageError(f"{out}: a native recording is a folder; leave out the ending or the format.")
        check_free(out, overwrite, "meta.yaml")
        return
    check_ending(out, chosen)
    check_free(out, overwrite, "" if out.suffix in FORMAT_OF_ENDING else "metadata.yaml")
    for path in truth_beside(out):
        check_free(path, overwrite)


def _sequence(
    world: str,
    sensor: str,
    duration: float | None,
    seed: int,
    motion: MotionOptions,
    sensors: SensorOptions,
    errors: ErrorOptions,
) -> SimulatedSequence:
    for name, rate in (("--imu-rate", sensors.imu_rate), ("--gps-rate", sensors.gps_rate)):
        if not 0 <= rate <= 10_000:
            raise UsageError(f"{name}: {rate} is impossible; give samples per second, or 0 for none.")
    if seed < 0:
        raise UsageError(f"--seed: {seed} is impossible; give 0 or more.")
    given = {key: value for key, value in vars(errors).items() if value is not None}
    imu = ImuModel(rate=sensors.imu_rate, **{key: given[key] for key in vars(ImuModel()) if key in given})
    gps = GpsModel(rate=sensors.gps_rate)
    if "gps_noise" in given:
        gps = replace(gps, noise=(given["gps_noise"],) * 3)
    renamed = {"multipath": "gps_multipath", "outage_every": "gps_outage_every"}
    gps = replace(gps, **{key: given[option] for key, option in renamed.items() if option in given})
    return SimulatedSequence(
        world,
        _lidar(sensor, errors.range_noise),
        duration if motion.trajectory or duration is not None else _DURATION,
        seed,
        imu=imu if sensors.imu_rate else None,
        gps=gps if sensors.gps_rate else None,
        standstill_s=motion.standstill,
        moving_start=motion.moving_start,
        swing_rate=motion.swing_rate,
        trajectory=_trajectory(motion.trajectory),
        T_imu_lidar=_extrinsic(sensors),
    )


def _lidar(sensor: str, range_noise: float | None) -> str | Lidar:
    if range_noise is None:
        return sensor
    if not range_noise >= 0:
        raise UsageError(f"--range-noise: {range_noise} is impossible; give m, 0 or more.")
    lidar = find_sensor(sensor).build()
    return eqx.tree_at(lambda lidar: lidar.ranging.sigma, lidar, jnp.float32(range_noise))


def _extrinsic(sensors: SensorOptions) -> NDArray[np.float64] | None:
    if sensors.lidar_translation is None and sensors.lidar_rotation is None:
        return None
    extrinsic = np.eye(4)
    if sensors.lidar_translation is not None:
        extrinsic[:3, 3] = sensors.lidar_translation
    if sensors.lidar_rotation is not None:
        norm = float(np.linalg.norm(sensors.lidar_rotation))
        if not abs(norm - 1) < 1e-3:
            raise UsageError(f"--lidar-rotation must be a unit quaternion x y z w (its norm is {norm:.4g}).")
        extrinsic[:3, :3] = Rotation.from_quat(sensors.lidar_rotation).as_matrix()
    return extrinsic


def _trajectory(path: Path | None) -> Trajectory | None:
    if path is None:
        return None
    from lio_jax.evaluation.load import load_trajectory

    loaded = load_trajectory(path)
    if not loaded.stamped:
        raise UsageError(f"{path}: has no time stamps; give a TUM file, or KITTI poses with their times.txt.")
    return loaded.trajectory


def _with_progress(sequence: SimulatedSequence) -> Iterator[LidarScan]:
    with tqdm(total=sequence.info.scan_count, unit="scan", disable=None, leave=False) as bar:
        for scan in sequence.scans():
            yield scan
            bar.update()


def _write_bag(
    sequence: SimulatedSequence,
    scans: Iterable[LidarScan],
    out: Path,
    bag_format: BagFormat,
    layout: str,
    overwrite: bool,
) -> int:
    """Write the bag and its truth, all files or none."""
    poses, arrays = truth_beside(out)
    with ExitStack() as stack:
        write_tum(stack.enter_context(written_whole(poses, overwrite)), sequence.truth())
        known: dict[str, Any] = sequence.truth_arrays()
        np.savez(stack.enter_context(written_whole(arrays, overwrite)), allow_pickle=False, **known)
        return write_bag(
            out, sequence, bag_format=bag_format, layout=layout, scans=scans, overwrite=overwrite
        )


def _summary(sequence: SimulatedSequence, out: Path, chosen: Format, rate: float) -> str:
    truth, info = sequence.truth(), sequence.info
    travelled = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum()
    imu, gps = sequence.imu(), sequence.gps()
    lines = [
        f"recording  {out}  ({chosen})",
        f"scans      {info.scan_count}  ({sequence.duration_s:.1f} s, {travelled:.2f} m travelled)",
        f"imu        {'none' if imu is None else f'{len(imu.stamp_ns)} samples'}",
        f"gps        {'none' if gps is None else f'{len(gps.stamp_ns)} fixes'}",
        f"speed      {rate:.1f} scans/s",
    ]
    words = ["lio-jax", "run", str(out), "--out", "DIR"]
    if chosen != "native" and info.T_imu_lidar is not None:
        poses, arrays = truth_beside(out)
        rotation = _plain(Rotation.from_matrix(info.T_imu_lidar[:3, :3]).as_quat())
        translation = _plain(info.T_imu_lidar[:3, 3])
        words += ["--gt", str(poses), "--set"]
        words += [f"params.extrinsics.rotation={rotation}", f"params.extrinsics.translation={translation}"]
        lines.append(f"truth      {poses}, {arrays}")
    return "\n".join([*lines, f"run it     {shlex.join(words)}"])


def _plain(values: NDArray[np.float64]) -> str:
    return f"[{','.join(f'{value:.9g}' for value in values)}]"


def demo(out: Path, overwrite: bool) -> None:
    """Run the default recipe on twelve seconds of simulated driving."""
    from lio_jax.commands.run import run_and_report
    from lio_jax.commands.runtime import say
    from lio_jax.settings.settings import Settings

    sequence = SimulatedSequence(world="city", sensor="generic32", duration_s=12.0, imu=ImuModel())
    say("simulating and tracking a 32-beam LiDAR and an IMU on twelve seconds of a city ...")
    run_and_report(sequence, Settings(), out, 0, None, sequence.truth(), overwrite)
