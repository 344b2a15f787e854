"""A simulated recording as a Sequence: each scan is ray cast when it is asked for."""

import math
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, SequenceInfo, scans_from
from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.city import city
from lio_jax.sim.collision import STEP, TOGETHER, check_clear
from lio_jax.sim.gps import GpsModel, simulate_gps
from lio_jax.sim.imu import GRAVITY, ImuModel, ImuTruth, simulate_imu
from lio_jax.sim.lidar import Lidar, Sweep, column_times, firing_times_ns, spinning_lidar, sweep
from lio_jax.sim.office import office
from lio_jax.sim.open_worlds import field, room, street
from lio_jax.sim.sensors import Layout, RosetteLidar, find_sensor
from lio_jax.sim.stairs import stairs
from lio_jax.sim.trajectory import SWING_RATE, Motion, motion_along, motion_through, pose_at
from lio_jax.sim.tunnel import tunnel
from lio_jax.sim.worlds import Counts, Part, Scene, World, counts_along, nearest_part

EPOCH_NS = 1_700_000_000_000_000_000
"""Absolute time of the recording's start, ns."""


def _default_extrinsic() -> NDArray[np.float64]:
    default = np.eye(4)
    default[:3, :3] = Rotation.from_euler("xyz", [0.6, -1.2, 2.5], degrees=True).as_matrix()
    default[:3, 3] = [0.1, 0.0, 0.2]
    return default


DEFAULT_T_IMU_LIDAR = _default_extrinsic()
"""Pose of the lidar in the IMU frame where none is given, (4, 4): a small lever arm and rotation."""

_TRUTH_STEP_NS = 10_000_000
_POSES_AT_ONCE = 4096
_STANDSTILL = 1.5
"""Default time at rest before the body moves off, s."""
_DURATION = 10.0
"""Default duration of a recording, s."""


WORLDS: dict[str, Callable[[int], Scene]] = {
    "city": city,
    "field": field,
    "office": office,
    "room": room,
    "stairs": stairs,
    "street": street,
    "tunnel": tunnel,
}
"""Builders by name: ``builder(seed) -> Scene``."""


def build(name: str, seed: int) -> Scene:
    """Return the world ``name`` (see WORLDS) for the seed ``seed``, with its route.

    Raises:
        UsageError: there is no such world.
    """
    if name not in WORLDS:
        raise UsageError(f"world '{name}' is unknown; choose one of: {', '.join(sorted(WORLDS))}.")
    return WORLDS[name](seed)


class SimulatedSequence:
    """A drive, walk or flight through a simulated world with exact truth.

    A scan depends on the arguments and its number only, not on the scans that were asked for before.
    """

    def __init__(
        self,
        world: str | Scene = "street",
        sensor: str | Lidar = "generic32",
        duration_s: float | None = None,
        seed: int = 0,
        *,
        beams: int | None = None,
        columns: int | None = None,
        imu: ImuModel | None = None,
        gps: GpsModel | None = None,
        standstill_s: float | None = None,
        moving_start: bool = False,
        swing_rate: float | None = None,
        trajectory: Trajectory | None = None,
        T_imu_lidar: NDArray[np.floating[Any]] | None = None,
    ) -> None:
        """Build the world and check that the motion is free; no scan is ray cast yet.

        Args:
            world: a name of ``WORLDS``, or a scene of your own.
            sensor: a name of ``sensors.SENSORS``, or a sensor.
            duration_s: length of the recording, s, in whole sweeps. None: the whole ``trajectory``, or 10 s.
            seed: seed of world, motion and noise.
            beams: number of beams of the sensor "generic32"; None: 32.
            columns: columns in a turn of the sensor "generic32"; None: 1024.
            imu: the inertial sensor; None: the recording has none.
            gps: the GPS receiver; None: the recording has none.
            standstill_s: time at rest at the route's start, s; None: 1.5, or 0 with a moving start.
            moving_start: whether the recording starts at full speed on the world's route.
            swing_rate: how fast a handheld body looks around on the world's route, rad/s, 0 to 10; None: 0.8.
            trajectory: T_world_imu to follow, from its first pose on, instead of the world's route.
            T_imu_lidar: (4, 4) pose of the lidar in the IMU frame; None: a small lever arm and rotation.

        Raises:
            UsageError: an unknown world or sensor, an impossible duration or extrinsic, or a motion that
                meets a surface.
        """
        scene = build(world, seed) if isinstance(world, str) else world
        name = world if isinstance(world, str) else "own"
        self.lidar, self.lidar_layout, description = _sensor(sensor, beams, columns)
        if duration_s is None:
            duration_s = _span(trajectory) if trajectory is not None else _DURATION
        if not self.lidar.period - 1e-9 <= duration_s < math.inf:
            raise UsageError(
                f"a duration of {duration_s} s holds no scan; give at least {self.lidar.period:g} s, a sweep."
            )
        self.world = scene.world
        if trajectory is None:
            rest = _STANDSTILL * (not moving_start) if standstill_s is None else standstill_s
            if swing_rate is not None and scene.route.dynamics != "handheld":
                raise UsageError(
                    f"in the world '{name}' nobody carries the sensor; leave the swing rate out."
                )
            self.motion: Motion = motion_along(
                scene.route,
                duration_s=duration_s,
                standstill_s=rest,
                moving_start=moving_start,
                seed=seed,
                swing_rate=SWING_RATE if swing_rate is None else swing_rate,
            )
        else:
            if moving_start or standstill_s or swing_rate is not None:
                raise UsageError(
                    "a trajectory itself says how it moves; "
                    "leave standstill, moving start and swing rate out."
                )
            if duration_s > _span(trajectory) + 1e-9:
                raise UsageError(
                    f"the trajectory ends after {_span(trajectory):.2f} s, before the wanted {duration_s} s; "
                    "shorten the duration."
                )
            self.motion = motion_through(trajectory)
        self._seed, self._imu_model, self._gps_model = seed, imu, gps
        extrinsic = _extrinsic(T_imu_lidar)
        # the motion is in double precision in every mode of JAX, because it is the truth
        with jax.enable_x64(True):
            wxyz = Rotation.from_matrix(extrinsic[:3, :3]).as_quat(scalar_first=True)
            self._T_imu_lidar = jaxlie.SE3(jnp.asarray(np.concatenate([wxyz, extrinsic[:3, 3]])))
        self._noise_key = jax.random.fold_in(jax.random.key(seed), 1)
        sigma = float(self.lidar.ranging.sigma)
        self.info = SequenceInfo(
            name=f"{name}_{seed}",
            format="simulated",
            path="",
            scan_count=int(duration_s / self.lidar.period + 1e-6),
            T_imu_lidar=extrinsic,
            sensor=f"simulated, {description}",
            notes=(f"{name} world, seed {seed}: ray cast, range noise {sigma:g} m.",),
        )
        times = np.arange(0.0, self.duration_s, STEP)
        positions = self.poses(times)[:, :3, 3]
        check_clear(self.world, times, positions)
        self._counts = self._counts_in_range(positions)

    @property
    def duration_s(self) -> float:
        """Return the length of the recording, s: a whole number of sweeps."""
        return self.info.scan_count * self.lidar.period_ns * 1e-9

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Ray cast and yield scans ``start`` to ``start + count``."""
        for number in range(self.info.scan_count)[scans_from(start, count)]:
            yield self._scan(number)

    def imu(self) -> ImuData | None:
        """Return the inertial samples, or None where no IMU was asked for."""
        return self._inertial[0] if self._inertial else None

    def gps(self) -> GpsData | None:
        """Return the GPS fixes, or None where no GPS was asked for."""
        if self._gps_model is None:
            return None
        return simulate_gps(self.motion, self._gps_model, self.duration_s, self._seed, EPOCH_NS)

    def truth(self) -> Trajectory:
        """Return T_world_imu every 10 ms from the first scan's start to the last scan's end."""
        steps = self.info.scan_count * self.lidar.period_ns // _TRUTH_STEP_NS
        offsets = np.arange(steps + 1, dtype=np.int64) * _TRUTH_STEP_NS
        return Trajectory(EPOCH_NS + offsets, self.poses(offsets * 1e-9))

    def truth_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the true quantities besides the poses, by name.

        ``T_imu_lidar`` (4, 4), ``range_sigma`` (m), ``gravity`` (3,) in world (m/s^2), and with an IMU its
        true biases, noise densities and time offset as :class:`~lio_jax.sim.imu.ImuTruth` names them.
        """
        known: dict[str, NDArray[Any]] = {
            "T_imu_lidar": np.asarray(self.info.T_imu_lidar),
            "range_sigma": np.asarray(self.lidar.ranging.sigma, np.float64),
            "gravity": GRAVITY,
        }
        return known | (self._inertial[1].arrays() if self._inertial else {})

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        """Return nothing: a simulated recording has no faults."""
        return ()

    def poses(self, times: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return (n, 4, 4) T_world_imu at ``times`` s from the recording's start, in double precision."""
        times = np.asarray(times, np.float64)
        found = []
        with jax.enable_x64(True):
            # pieces of one shape need one compiled program, and an hour needs no more memory than a minute
            for start in range(0, len(times), _POSES_AT_ONCE):
                piece = times[start : start + _POSES_AT_ONCE]
                padded = np.pad(piece, (0, _POSES_AT_ONCE - len(piece)), mode="edge")
                found.append(np.asarray(_poses(self.motion, jnp.asarray(padded)))[: len(piece)])
        return np.concatenate(found) if found else np.empty((0, 4, 4))

    @cached_property
    def _inertial(self) -> tuple[ImuData, ImuTruth] | None:
        if self._imu_model is None:
            return None
        return simulate_imu(self.motion, self._imu_model, self.duration_s, self._seed, EPOCH_NS)

    def _scan(self, number: int) -> LidarScan:
        start_ns = number * self.lidar.period_ns
        with jax.enable_x64(True):
            start = jnp.float64(start_ns * 1e-9)
            part, columns = _surroundings(
                self.world, self.motion, self._T_imu_lidar, start, self.lidar, self._counts
            )
            key = jax.random.fold_in(self._noise_key, number)
            seen = _sweep(self.lidar, part, columns, key, self.lidar.phase(start_ns))
        mask = np.asarray(seen.mask)
        times = (firing_times_ns(self.lidar) * 1e-9).astype(np.float32)
        return LidarScan(
            stamp_ns=EPOCH_NS + start_ns,
            points=np.asarray(seen.points)[mask],
            time=times[mask],
            ring=np.broadcast_to(np.array(self.lidar.ring, np.int32), mask.shape)[mask],
            intensity=np.asarray(seen.intensity)[mask],
            duration=self.lidar.period,
        )

    def _counts_in_range(self, positions: NDArray[np.float64]) -> Counts:
        """Return the largest numbers of solids of each kind in the sensor's range, anywhere on its way."""
        # the same number of positions as in the collision check: one compiled program serves both
        sampled = positions[::TOGETHER]
        driven = np.linalg.norm(np.diff(sampled, axis=0, append=positions[-1:]), axis=1).max()
        lever = np.linalg.norm(np.asarray(self.info.T_imu_lidar)[:3, 3])
        # the body's way between the checked positions, and during a sweep that starts at one of them
        margin = 2 * driven + lever + 1.0
        radius = float(self.lidar.ranging.maximum + margin)
        with jax.enable_x64(True):
            counts = counts_along(self.world, jnp.asarray(sampled), radius)
        return Counts(*(_rounded_up(int(count)) for count in counts))


def _sensor(sensor: str | Lidar, beams: int | None, columns: int | None) -> tuple[Lidar, Layout, str]:
    if sensor == "generic32" and (beams or columns):
        chosen = spinning_lidar(beams or 32, columns or 1024)
        return chosen, "velodyne", f"ideal, {chosen.beams} beams x {chosen.columns} columns"
    if beams or columns:
        raise UsageError(f"sensor {sensor}: beams and columns can be set for generic32 only; leave them out.")
    if isinstance(sensor, str):
        found = find_sensor(sensor)
        return found.build(), found.layout, found.description
    layout: Layout = "livox" if isinstance(sensor, RosetteLidar) else "velodyne"
    return sensor, layout, f"{sensor.beams} beams x {sensor.columns} columns"


def _rounded_up(count: int) -> int:
    """Return ``count`` raised by up to 14 %, so that most seeds and durations share one compiled program."""
    step = max(1, 2 ** (count.bit_length() - 4))
    return -(-count // step) * step


def _span(trajectory: Trajectory) -> float:
    return float(trajectory.stamp_ns[-1] - trajectory.stamp_ns[0]) * 1e-9 if len(trajectory) else 0.0


def _extrinsic(T_imu_lidar: NDArray[np.floating[Any]] | None) -> NDArray[np.float64]:
    """Return the (4, 4) extrinsic as given, or the default."""
    if T_imu_lidar is None:
        return DEFAULT_T_IMU_LIDAR.copy()
    matrix = np.asarray(T_imu_lidar, np.float64)
    rotation = matrix[:3, :3]
    if matrix.shape != (4, 4) or not (
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
    ):
        raise UsageError(
            "T_imu_lidar is not a rigid transform; give a 4x4 with a rotation in its upper left."
        )
    return matrix


@jax.jit
def _poses(motion: Motion, times: Float[Array, " n"]) -> Float[Array, "n 4 4"]:
    return jax.vmap(lambda time: pose_at(motion, time).as_matrix())(times)


@eqx.filter_jit
def _surroundings(
    world: World,
    motion: Motion,
    T_imu_lidar: jaxlie.SE3,
    start: Float[Array, ""],
    lidar: Lidar,
    counts: Counts,
) -> tuple[Part, jaxlie.SE3]:
    """Return the solids in range and the lidar poses at the columns' times.

    Both are relative to the lidar's position at the sweep's start, because rays are exact near the origin.
    """
    times = start + jnp.asarray(column_times(lidar))
    poses = jax.vmap(lambda time: pose_at(motion, time) @ T_imu_lidar)(times)
    center = poses.translation()[0]
    local = jaxlie.SE3.from_rotation_and_translation(poses.rotation(), poses.translation() - center)
    part, _ = nearest_part(world, center, start, counts)
    return part, local


@eqx.filter_jit
def _sweep(
    lidar: Lidar, part: Part, columns: jaxlie.SE3, key: PRNGKeyArray, phase: Float[Array, "2"]
) -> Sweep:
    return sweep(lidar, part, columns, key, phase)
