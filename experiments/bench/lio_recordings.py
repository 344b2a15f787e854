"""Simulated LiDAR-inertial recordings, written once as native folders that every system reads."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lio_jax.data.trajectory import Trajectory

Motion = Literal["driven", "moving_start", "fast_rotation"]
"""Kind of motion.

driven: the world's own body, first at rest; moving_start: at full speed from the start; fast_rotation: a hand
that looks around at up to 4 rad/s.
"""

STANDSTILL_S = 2.0
SWING_RATE = 4.0
_POSE_STEP_S = 0.01


@dataclass(frozen=True)
class Recording:
    """The arguments that determine one simulated recording."""

    world: str
    sensor: str
    seed: int
    seconds: float
    motion: Motion = "driven"

    @property
    def group(self) -> str:
        """Name without the seed."""
        return f"{self.world}_{self.sensor}" + (f"_{self.motion}" if self.motion != "driven" else "")

    @property
    def name(self) -> str:
        """Name of its table and of its folder."""
        return f"{self.group}_{self.seconds:g}s_seed{self.seed}"

    @property
    def starts_at_rest(self) -> bool:
        """Whether the body is at rest first; some systems need to know this."""
        return self.motion != "moving_start"


SPECIAL: dict[str, tuple[str, str, Motion]] = {
    "fast_rotation": ("office", "generic32", "fast_rotation"),
    "drone": ("field", "generic32", "driven"),
    "moving_start": ("street", "generic32", "moving_start"),
}
"""World, sensor and motion, by name, of recordings that test a system's robustness."""


def written(recording: Recording, folder: Path) -> Path:
    """Return the recording's native folder; simulate it if it does not exist yet."""
    from lio_jax.data.native_writer import write_native
    from lio_jax.sim.imu import ImuModel
    from lio_jax.sim.sequence import SimulatedSequence

    path = folder / recording.name
    if path.is_dir():
        return path
    quick = recording.motion == "fast_rotation"
    sequence = SimulatedSequence(
        recording.world,
        recording.sensor,
        recording.seconds,
        recording.seed,
        imu=ImuModel(),
        standstill_s=STANDSTILL_S if recording.motion == "driven" else None,
        moving_start=recording.motion == "moving_start",
        trajectory=_quick_hand(recording) if quick else None,
    )
    folder.mkdir(parents=True, exist_ok=True)
    lidar = sequence.lidar
    geometry = {
        "beams": lidar.beams,
        "columns": lidar.columns,
        "min_range": float(lidar.ranging.minimum),
        "max_range": float(lidar.ranging.maximum),
        "starts_at_rest": recording.starts_at_rest,
    }
    write_native(
        path,
        sequence.scans(),
        name=recording.name,
        sensor=sequence.info.sensor,
        T_imu_lidar=sequence.info.T_imu_lidar,
        imu=sequence.imu(),
        truth=sequence.truth(),
        truth_arrays={**sequence.truth_arrays(), **geometry},
    )
    return path


def _quick_hand(recording: Recording) -> Trajectory:
    """Return T_world_imu of a hand on the world's route that turns as fast as a wrist can."""
    import jax
    import jax.numpy as jnp

    from lio_jax.sim.sequence import build
    from lio_jax.sim.trajectory import motion_along, pose_at

    motion = motion_along(
        build(recording.world, recording.seed).route,
        duration_s=recording.seconds,
        standstill_s=STANDSTILL_S,
        seed=recording.seed,
        swing_rate=SWING_RATE,
    )
    times = np.arange(round(recording.seconds / _POSE_STEP_S) + 1) * _POSE_STEP_S
    with jax.enable_x64(True):
        poses = np.asarray(
            jax.jit(jax.vmap(lambda time: pose_at(motion, time).as_matrix()))(jnp.asarray(times))
        )
    return Trajectory(np.round(times * 1e9).astype(np.int64), poses)
