"""A short simulated drive along a street, as every recipe takes it: arrays of each scan, and the truth."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from lio_jax.run.scan_inputs import ImuFeed, padded
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from tests.params import Config

SCANS = 30
MOVING = 10
"""By then the drive has pulled away."""


@cache
def recording():
    """Return the drive, its scans and its inertial samples."""
    sequence = SimulatedSequence(
        "street", duration_s=SCANS / 10, beams=16, columns=512, imu=ImuModel(), standstill_s=0.2, seed=1
    )
    return sequence, tuple(sequence.scans()), sequence.imu()


@cache
def truth() -> np.ndarray:
    """Return the true poses (SCANS, 4, 4) at the scans' ends."""
    sequence, scans, _ = recording()
    stamps = np.array([scan.end_ns for scan in scans])
    return sequence.poses((stamps - scans[0].stamp_ns) * 1e-9)


def ate(poses: np.ndarray) -> float:
    """Root mean square position error after the best rigid alignment, m."""
    estimate, true = poses[:, :3, 3], truth()[: len(poses), :3, 3]
    rotation, _ = Rotation.align_vectors(true - true.mean(0), estimate - estimate.mean(0))
    errors = rotation.apply(estimate - estimate.mean(0)) - (true - true.mean(0))
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


@cache
def arrays(config: Config, inertial: bool):
    """Return each scan's padded arrays and its samples, and the samples before the first; else None."""
    _, scans, imu = recording()
    feed = ImuFeed(imu, config.imu.buckets, 0.0, 0.0) if inertial else None
    last, inputs = None, []
    for scan in scans:
        samples = feed.batch(scan, last) if feed else None
        inputs.append(jax.tree.map(jnp.asarray, (padded(scan, last, config.lidar), samples)))
        last = scan.end_ns
    return inputs, jax.tree.map(jnp.asarray, feed.before(scans[0])) if feed else None


@dataclass(frozen=True)
class Driven:
    """What a recipe made of the drive."""

    states: list[Any]
    outputs: list[Any]

    @property
    def poses(self) -> np.ndarray:
        """T_world_imu at the scans' ends, (n, 4, 4)."""
        return np.stack([np.asarray(state.nav.T_world_imu.as_matrix()) for state in self.states])
