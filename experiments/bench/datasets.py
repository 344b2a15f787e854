"""The recordings of a comparison: decoded scans and their references."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from oxts_reference import ins_reference
from scoring import Reference

from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.data.trajectory import Trajectory

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
"""Folder of real recordings next to a checkout, if there are any."""

REAL = {
    "kitti_odometry_04": SHARED / "kitti_odometry/sequences/04",
    "kitti_raw_0005": SHARED / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync",
    "kitti_raw_0060": SHARED / "kitti_raw/2011_09_26/2011_09_26_drive_0060_sync",
}

_STANDING_M = 1.0
"""A drive whose reference covers less than this distance counts as standing, m."""


@dataclass(frozen=True)
class Dataset:
    """Scans in memory, and their reference."""

    name: str
    scans: list[LidarScan]
    T_imu_lidar: NDArray[np.float64]
    reference: Reference | None


def recorded(path: Path, name: str | None, start: int, count: int | None) -> Dataset:
    """Open a recording of any known format and decode its scans.

    Args:
        path: path as for ``lio_jax.data.open_sequence``.
        name: name for the table; None: the recording's own.
        start: index of the first scan.
        count: number of scans; None: all.
    """
    from lio_jax.data.config import DataConfig
    from lio_jax.data.detect import open_sequence

    sequence = open_sequence(path, DataConfig())
    scans = [scan for scan in sequence.scans(start, count) if len(scan.points)]
    kind, truth = "poses", sequence.truth()
    if sequence.info.format == "kitti_raw" and truth is not None:
        # GPS jumps make the INS position useless over a few scans; its velocity is good
        truth = ins_reference(path / "oxts")
        span = truth.at(np.array([scan.end_ns for scan in scans]))
        standing = np.linalg.norm(np.diff(span.positions, axis=0), axis=1).sum() < _STANDING_M
        kind = "standing" if standing else "ins"
    return _dataset(sequence, name, scans, truth, kind)


def simulated(count: int | None, seed: int = 0) -> Dataset:
    """Ray cast a drive through the built-in street."""
    from lio_jax.sim.sequence import SimulatedSequence

    sequence = SimulatedSequence(duration_s=(count or 200) * 0.1, seed=seed)
    return _dataset(sequence, None, list(sequence.scans()), sequence.truth(), "poses")


def _dataset(
    sequence: Sequence, name: str | None, scans: list[LidarScan], truth: Trajectory | None, kind: str
) -> Dataset:
    if not scans:
        raise SystemExit(f"{sequence.info.path or sequence.info.name}: no scans in the chosen range.")
    extrinsic = sequence.info.T_imu_lidar
    T_imu_lidar = np.eye(4) if extrinsic is None else np.asarray(extrinsic, np.float64)
    reference = None if truth is None else Reference(kind, truth.times_body(T_imu_lidar))
    return Dataset(name or sequence.info.name, scans, T_imu_lidar, reference)
