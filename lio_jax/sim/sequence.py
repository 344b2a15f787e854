"""A simulated drive as a Sequence: scans are ray cast when they are asked for."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, SequenceInfo
from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.lidar import SpinningLidar, Sweep, column_times, spinning_lidar, sweep
from lio_jax.sim.street import street
from lio_jax.sim.trajectory import Drive, pose_at
from lio_jax.sim.worlds import World, counts_within, nearest_part

WORLDS = {"street": street}
"""Name to builder: ``builder(seed) -> (World, Drive)``."""

EPOCH_NS = 1_700_000_000_000_000_000
"""Absolute time of the drive's start, ns."""

_TRUTH_STEP_NS = 10_000_000


class SimulatedSequence:
    """A drive through a simulated world with exact truth; a scan depends on the seed and its number only."""

    def __init__(
        self,
        world: str = "street",
        beams: int = 32,
        columns: int = 1024,
        duration_s: float = 10.0,
        seed: int = 0,
    ) -> None:
        """Build the world; nothing is ray cast yet.

        Args:
            world: a name of ``WORLDS``.
            beams: of the spinning LiDAR.
            columns: firings per turn.
            duration_s: of the drive, s; whole turns only.
            seed: of world and noise.

        Raises:
            UsageError: the world is unknown or the drive is shorter than one turn.
        """
        if world not in WORLDS:
            raise UsageError(f"world '{world}' is unknown; choose one of: {', '.join(sorted(WORLDS))}.")
        self.lidar = spinning_lidar(beams, columns)
        count = int(duration_s / self.lidar.period + 1e-6)
        if count < 1:
            raise UsageError(
                f"a duration of {duration_s} s holds no scan; give at least {self.lidar.period} s (one turn)."
            )
        # states in double precision whatever the caller's setting: truth is truth
        with jax.enable_x64(True):
            self.world, self.drive = WORLDS[world](seed)
            self._T_imu_lidar = jaxlie.SE3.from_rotation_and_translation(
                jaxlie.SO3.from_rpy_radians(*jnp.deg2rad(jnp.array([0.6, -1.2, 2.5]))),
                jnp.array([0.1, 0.0, 0.2]),
            )
            T_imu_lidar = np.asarray(self._T_imu_lidar.as_matrix())
        self._noise_key = jax.random.fold_in(jax.random.key(seed), 1)
        self._period_ns = round(self.lidar.period * 1e9)
        self.info = SequenceInfo(
            name=f"{world}_{seed}",
            format="simulated",
            path="",
            scan_count=count,
            T_imu_lidar=T_imu_lidar,
            sensor=f"simulated, {beams} beams x {columns} columns",
            notes=(
                f"{world} world, seed {seed}: ray cast, range noise {float(self.lidar.range_sigma):g} m.",
            ),
        )
        self._part_counts = self._counts_in_range()

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Ray cast and yield scans ``start`` to ``start + count``."""
        stop = self.info.scan_count if count is None else min(start + count, self.info.scan_count)
        for number in range(start, stop):
            yield self._scan(number)

    def imu(self) -> ImuData | None:
        """Return None: inertial samples are not simulated."""
        return None

    def gps(self) -> GpsData | None:
        """Return None: GPS is not simulated."""
        return None

    def truth(self) -> Trajectory:
        """Return T_world_imu every 10 ms from the first scan's start to the last scan's end."""
        steps = self.info.scan_count * self._period_ns // _TRUTH_STEP_NS
        offsets = np.arange(steps + 1, dtype=np.int64) * _TRUTH_STEP_NS
        return Trajectory(EPOCH_NS + offsets, self.poses(offsets * 1e-9))

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        """Return nothing: a simulated drive has no faults."""
        return ()

    def poses(self, times: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return (n, 4, 4) T_world_imu at ``times`` s from the drive's start, in double precision."""
        with jax.enable_x64(True):
            return np.asarray(_poses(self.drive, jnp.asarray(times, jnp.float64)).as_matrix())

    def _scan(self, number: int) -> LidarScan:
        with jax.enable_x64(True):
            start = jnp.float64(number * self._period_ns * 1e-9)
            columns, center = _column_poses(self.drive, self._T_imu_lidar, start, self.lidar)
        key = jax.random.fold_in(self._noise_key, number)
        turn = _turn(self.lidar, self.world, columns, center, key, self._part_counts)
        mask = np.asarray(turn.mask)
        times = np.asarray(column_times(self.lidar), np.float32)
        return LidarScan(
            stamp_ns=EPOCH_NS + number * self._period_ns,
            points=np.asarray(turn.points)[mask],
            time=np.broadcast_to(times[:, None], mask.shape)[mask],
            ring=np.broadcast_to(np.arange(mask.shape[1], dtype=np.int32), mask.shape)[mask],
            intensity=np.asarray(turn.intensity)[mask],
            duration=self.lidar.period,
        )

    def _counts_in_range(self) -> tuple[int, int]:
        """Return how many boxes and cylinders the sensor can have in range at once, anywhere on the drive."""
        duration = self.info.scan_count * self.lidar.period
        positions = self.poses(np.arange(int(duration) + 2) * 1.0)[:, :3, 3].astype(np.float32)
        # positions are sampled once a second: the margin covers what is driven in between
        radius = float(self.lidar.max_range) + 15.0
        counts = np.asarray(_all_counts(self.world, jnp.asarray(positions), jnp.float32(radius))).max(axis=0)
        return int(counts[0]), int(counts[1])


@jax.jit
def _poses(drive: Drive, times: Float[Array, " n"]) -> jaxlie.SE3:
    return jax.vmap(partial(pose_at, drive))(times)


@jax.jit
def _all_counts(world: World, positions: Float[Array, "n 3"], radius: Float[Array, ""]) -> Array:
    return jax.vmap(lambda position: counts_within(world, position, radius))(positions)


@jax.jit
def _column_poses(
    drive: Drive, T_imu_lidar: jaxlie.SE3, start: Float[Array, ""], lidar: SpinningLidar
) -> tuple[jaxlie.SE3, Float[Array, "3"]]:
    """Return float32 lidar poses at the firing times, relative to the position where the turn starts."""
    poses = jax.vmap(lambda time: pose_at(drive, time) @ T_imu_lidar)(start + column_times(lidar))
    center = poses.translation()[0]
    local = jaxlie.SE3.from_rotation_and_translation(poses.rotation(), poses.translation() - center)
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), local), center.astype(jnp.float32)


@eqx.filter_jit
def _turn(
    lidar: SpinningLidar,
    world: World,
    columns: jaxlie.SE3,
    center: Float[Array, "3"],
    key: PRNGKeyArray,
    part_counts: tuple[int, int],
) -> Sweep:
    part, _ = nearest_part(world, center, *part_counts)
    return sweep(lidar, part, columns, key)
