"""A short simulated drive with inertial samples, and what recordings do to them."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.sequence import GpsData, ImuData, LidarScan, SequenceInfo
from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence

START, END = 5, 35
"""The vehicle stands for half a second more, pulls away and drives a curve at up to 5 m/s."""
RATE = 100.0


@cache
def drive() -> SimulatedSequence:
    return SimulatedSequence(
        beams=16, columns=256, duration_s=9.0, seed=1, imu=ImuModel(rate=RATE), standstill_s=1.0
    )


@cache
def scan(number: int) -> LidarScan:
    return next(drive().scans(number, 1))


@cache
def truth() -> Trajectory:
    return drive().truth()


def scans(start: int = START, end: int = END) -> list[LidarScan]:
    return [scan(number) for number in range(start, end)]


def imu() -> ImuData:
    samples = drive().imu()
    assert samples is not None
    return samples


def seconds() -> NDArray[np.float64]:
    """Return the samples' times from the first scan's start."""
    return (imu().stamp_ns - scan(START).stamp_ns) * 1e-9


def only(kept: NDArray[np.bool_]) -> ImuData:
    samples = imu()
    return ImuData(samples.stamp_ns[kept], samples.gyro[kept], samples.accel[kept])


def changed(rows: slice | NDArray[np.bool_] = slice(None), **values) -> ImuData:
    """Return the samples with rows of a field replaced."""
    samples = imu()
    fields = {}
    for name, value in values.items():
        fields[name] = getattr(samples, name).copy()
        fields[name][rows] = value
    return replace(samples, **fields)


class InertialReplay:
    """A Sequence of given scans and samples, in memory."""

    def __init__(self, scans: Iterable[LidarScan], imu: ImuData | None) -> None:
        self._scans, self._imu = list(scans), imu
        self.info = SequenceInfo("replay", "memory", "memory", len(self._scans), drive().info.T_imu_lidar)
        self.warnings_so_far: tuple[str, ...] = ()

    def scans(self, start: int = 0, count: int | None = None):
        yield from self._scans[start : None if count is None else start + count]

    def imu(self) -> ImuData | None:
        return self._imu

    def gps(self) -> GpsData | None:
        return None

    def truth(self) -> Trajectory | None:
        return truth()


def errors(estimate: Trajectory, start: Trajectory | None = None) -> NDArray[np.float64]:
    """Return position errors, m, the truth laid into the world of the first pose of ``start``."""
    first = start or estimate
    true_start = truth().at(first.stamp_ns[:1]).poses[0]
    expected = first.poses[0] @ np.linalg.inv(true_start) @ truth().at(estimate.stamp_ns).poses
    return np.linalg.norm((estimate.poses - expected)[:, :3, 3], axis=1)
