"""A simulated walk through an office, which turns about all axes, and what recordings do to it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.data import open_sequence, write_native
from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.inspection import Inspection, inspect_sequence
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence

SCANS = 32


@dataclass(frozen=True)
class Walk:
    """The recorded data of a walk."""

    scans: tuple[LidarScan, ...]
    imu: ImuData | None
    T_imu_lidar: NDArray[np.float64] | None


Change = Callable[[Walk], Walk]


@cache
def walk() -> Walk:
    """The healthy recording."""
    drive = SimulatedSequence(
        "office", beams=16, columns=256, duration_s=SCANS / 10, seed=1, imu=ImuModel(), moving_start=True
    )
    return Walk(tuple(drive.scans()), drive.imu(), drive.info.T_imu_lidar)


def inspected(path: Path, recorded: Walk) -> Inspection:
    """Write a recording and inspect it."""
    write_native(path / "walk", recorded.scans, T_imu_lidar=recorded.T_imu_lidar, imu=recorded.imu)
    return inspect_sequence(open_sequence(path / "walk"))


def with_imu(change: Callable[[ImuData], ImuData]) -> Change:
    """Change the inertial samples."""

    def changed(recorded: Walk) -> Walk:
        assert recorded.imu is not None
        return replace(recorded, imu=change(recorded.imu))

    return changed


def with_scans(change: Callable[[int, LidarScan], LidarScan | None]) -> Change:
    """Change scans by their number; None leaves one out."""

    def changed(recorded: Walk) -> Walk:
        scans = [change(number, scan) for number, scan in enumerate(recorded.scans)]
        return replace(recorded, scans=tuple(scan for scan in scans if scan is not None))

    return changed


def turned(recorded: Walk, degrees: float, axis: str) -> Walk:
    """Say that the lidar is mounted otherwise than it is."""
    assert recorded.T_imu_lidar is not None
    wrong = np.eye(4)
    wrong[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return replace(recorded, T_imu_lidar=recorded.T_imu_lidar @ wrong)
