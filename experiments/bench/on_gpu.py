"""Time of steps, of many parameter sets at once and of gradients on an accelerator, beside the CPU.

    python experiments/bench/on_gpu.py [--sets 64 1024] [--recipes default fast_lio2 lio_sam loam gradient]
        [--kitti SEQUENCE] [--scans 20] [--on cpu gpu] [--most-seconds 240] [--json]

A step is timed from the host's padded scan to the pose on the device, as ``lio-jax run`` does it. Each row is
measured twice over the same scans, and the last column says whether both gave the same bits. Rows of the CPU
come from the same process. Their poses are the reference of the column "m off".
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.commands.runtime import prepare_jax
from lio_jax.data.detect import open_sequence
from lio_jax.data.sequence import Sequence
from lio_jax.recipes.transforms import RecipeLike, batched
from lio_jax.run.compiled import Compiled
from lio_jax.run.run import imu_feed, settings_for
from lio_jax.run.scan_inputs import ScanInput
from lio_jax.run.track import run_steps, scan_inputs
from lio_jax.settings.settings import Settings, recipe_of, recipe_settings
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from lio_jax.tuning.objectives import objective_named
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.recording import Recording
from lio_jax.tuning.streaming import streaming_gradient

_OPENING = 5
"""Number of first scans whose time does not count."""
_NAMES = ("default", "fast_lio2", "lio_sam", "loam", "gradient")
"""What is measured; "gradient" is that of the default recipe's likelihood by the parameters below."""
_TUNED = ("imu.*_noise", "imu.*_walk", "initial.*_sigma", "lidar.range_sigma", "extrinsics.translation")


class Drive(NamedTuple):
    """A recording in memory, ready for a recipe."""

    settings: Settings
    fed: list[ScanInput]
    sequence: Sequence


class Row(NamedTuple):
    """Result of one recipe on one recording with one number of parameter sets."""

    name: str
    device: str
    sets: int
    compile_s: float
    step_ms: float
    p95_ms: float
    off_m: float
    same_bits: bool
    all_ms: list[float]


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--sets", type=int, nargs="+", default=[64, 1024], help="numbers of parameter sets, for default"
    )
    parser.add_argument("--recipes", nargs="+", default=_NAMES, help="recipes, and 'gradient'")
    parser.add_argument("--kitti", type=Path, help="a sequence of KITTI odometry: 64 beams, no IMU")
    parser.add_argument("--scans", type=int, default=20)
    parser.add_argument("--on", nargs="+", default=["cpu", "gpu"], help="platforms")
    parser.add_argument("--most-seconds", type=float, default=240.0, help="begin no row after this time")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    prepare_jax()
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}")
    began, rows, reference = time.perf_counter(), [], {}
    print(
        f"{'recording and recipe':28}{'on':6}{'sets':>6}{'compile s':>11}{'ms':>9}{'p95':>9}{'ms a set':>10}"
        f"{'m off':>11}  same bits"
    )
    drives: dict[tuple[str, str], Drive] = {}
    for platform, kind, recipe, sets in _jobs(options):
        device = jax.devices(platform)[0]
        if time.perf_counter() - began > options.most_seconds:
            print(f"{kind} {recipe} on {platform} with {sets} sets: left out, the time is over")
            continue
        if (kind, recipe) not in drives:
            with jax.default_device(jax.devices("cpu")[0]):
                drives[kind, recipe] = _drive(kind, recipe, options)
        try:
            with jax.default_device(device):
                row, poses = _measured(f"{kind} {recipe}", platform, drives[kind, recipe], sets)
        except jax.errors.JaxRuntimeError as error:
            print(f"{kind} {recipe} on {platform} with {sets} sets failed: {str(error)[:300]}")
            continue
        first = reference.setdefault((kind, recipe), poses[:, 0])
        row = row._replace(off_m=float(np.abs(poses[:, 0] - first)[:, 4:].max()))
        rows.append(row._asdict())
        print(
            f"{row.name:28}{row.device:6}{row.sets:6d}{row.compile_s:11.1f}{row.step_ms:9.2f}{row.p95_ms:9.2f}"
            f"{row.step_ms / row.sets:10.3f}{row.off_m:11.2e}  {'yes' if row.same_bits else 'no'}",
            flush=True,
        )
    if options.json:
        print(json.dumps({"rows": rows}))


def _jobs(options: argparse.Namespace) -> list[tuple[str, str, str, int]]:
    jobs = []
    for platform in options.on:
        jobs += [(platform, "kitti", "default", 1)] * (options.kitti is not None)
        jobs += [(platform, "street", recipe, 1) for recipe in options.recipes]
        jobs += [(platform, "street", "default", sets) for sets in options.sets if platform != "cpu"]
    return jobs


def _drive(kind: str, recipe: str, options: argparse.Namespace) -> Drive:
    sequence: Sequence
    if kind == "kitti":
        sequence = open_sequence(options.kitti)
    else:
        sequence = SimulatedSequence("street", "generic32", options.scans * 0.1, seed=0, imu=ImuModel())
    settings, _ = settings_for(sequence, recipe_settings("default" if recipe == "gradient" else recipe))
    imu, _ = imu_feed(sequence, settings)
    fed = list(scan_inputs(settings, sequence.scans(0, options.scans), imu))
    return Drive(settings, fed, sequence)


def _measured(name: str, device: str, drive: Drive, sets: int) -> tuple[Row, NDArray[np.float64]]:
    """Return the row and the (scans, sets, 7) poses of the first run."""
    if name.endswith("gradient"):
        return _measured_gradient(name, device, drive)
    recipe, params = recipe_of(drive.settings), drive.settings.params()
    stepper = Compiled(recipe, params)
    if sets > 1:
        scales = jnp.geomspace(0.5, 2.0, sets)
        many = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (sets, *leaf.shape)), params)
        sigma = many.lidar.range_sigma
        many = eqx.tree_at(lambda params: params.lidar.range_sigma, many, sigma * scales.astype(sigma.dtype))
        stepper = Compiled(batched(recipe), many)
    _, warm = _run(stepper, drive.fed, sets)
    ms, poses = _run(stepper, drive.fed, sets)
    return _row(name, device, sets, stepper.compile_s, ms, np.array_equal(warm, poses, equal_nan=True)), poses


def _run(stepper: Compiled, fed: list[ScanInput], sets: int) -> tuple[list[float], NDArray[np.float64]]:
    ms, poses = [], []
    for one, state, _ in run_steps(stepper, fed):
        pose = jax.block_until_ready(state.nav.T_world_imu.wxyz_xyz)
        ms.append((time.perf_counter() - one.begun_at) * 1e3)
        poses.append(np.asarray(pose, np.float64).reshape(sets, 7))
    return ms, np.array(poses)


class _Timed(Recording):
    """Takes the time between the return of each scan and the request for the next one."""

    def scan_inputs(self) -> Any:
        self.ms: list[float] = []
        for fed in super().scan_inputs():
            start = time.perf_counter()
            yield fed
            self.ms.append((time.perf_counter() - start) * 1e3)


def _measured_gradient(name: str, device: str, drive: Drive) -> tuple[Row, NDArray[np.float64]]:
    free = free_parameters(drive.settings.params(), list(_TUNED))
    recording = _Timed(drive.sequence, drive.settings, 0, len(drive.fed))
    recipe: RecipeLike = recipe_of(drive.settings)
    about = recipe, free, objective_named("noise").objective, free.first(), recording
    start = time.perf_counter()
    warm = streaming_gradient(*about, False)
    compile_s = time.perf_counter() - start
    again = streaming_gradient(*about, False)
    same = np.array_equal(warm.gradient, again.gradient)
    print(f"{len(free.names)} parameters, gradient {np.array2string(again.gradient, precision=4)}")
    return _row(name, device, 1, compile_s, recording.ms, same), np.zeros((1, 1, 7))


def _row(name: str, device: str, sets: int, compile_s: float, ms: list[float], same: bool) -> Row:
    counted = ms[_OPENING:]
    return Row(
        name,
        device,
        sets,
        compile_s,
        float(np.median(counted)),
        float(np.percentile(counted, 95)),
        0.0,
        same,
        ms,
    )


if __name__ == "__main__":
    main()
