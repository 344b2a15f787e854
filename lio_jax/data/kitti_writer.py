"""Write any Sequence as a KITTI odometry sequence: velodyne/*.bin, times.txt, calib.txt and poses.txt."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.data.trajectory import Trajectory, write_kitti_poses
from lio_jax.data.velodyne_file import raise_elevation
from lio_jax.data.whole_output import written_whole

MARKER = "times.txt"
"""A folder that holds this file may be overwritten."""

_BEYOND_NS = 1_000_000
"""Largest extrapolation of the truth beyond its ends, ns: in 1 ms no body moves far."""
_T_CAM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Pose of the lidar in the camera frame (KITTI's poses are camera poses): same place, z ahead and y down."""


def write_kitti(
    path: Path,
    sequence: Sequence,
    *,
    vertical_correction_deg: float,
    scans: Iterable[LidarScan] | None = None,
    overwrite: bool = False,
) -> int:
    """Write a sequence folder and return its number of scans (scans are streamed).

    A scan's stamp is the time of its middle, counted from the first scan's middle. Points are stored as in
    KITTI, which has no ring field: ring after ring, by rising azimuth from straight ahead. Poses are written
    if the truth covers every scan.

    Args:
        path: path of the folder; it appears only when all its files are written.
        sequence: the recording to write.
        vertical_correction_deg: angle by which readers raise the points; they are lowered by it here.
        scans: scans to write in place of the sequence's own, for example the same scans with a progress bar.
        overwrite: whether an existing sequence folder is replaced.

    Raises:
        UsageError: ``path`` exists and may not be replaced.
        LioJaxError: there are no scans, or the disk is full or cannot be written.
    """
    path = Path(path)
    with written_whole(path, overwrite, MARKER) as aside:
        (aside / "velodyne").mkdir(parents=True)
        middles_ns: list[int] = []
        for scan in sequence.scans() if scans is None else scans:
            rows = _rows(scan, vertical_correction_deg)
            rows.tofile(aside / "velodyne" / f"{len(middles_ns):06d}.bin")
            middles_ns.append(scan.stamp_ns + round(scan.duration * 0.5e9))
        if not middles_ns:
            raise LioJaxError(f"{path}: there are no scans to write, the folder was not made.")
        stamps = np.array(middles_ns, np.int64)
        seconds = [f"{(stamp - stamps[0]) * 1e-9:.9f}" for stamp in stamps]
        (aside / "times.txt").write_text("\n".join(seconds) + "\n")
        numbers = " ".join(f"{value:.12e}" for value in _T_CAM_LIDAR[:3].ravel())
        (aside / "calib.txt").write_text(f"Tr: {numbers}\n")
        poses = _camera_poses(sequence, stamps)
        if poses is not None:
            write_kitti_poses(aside / "poses.txt", poses)
    return len(middles_ns)


def _rows(scan: LidarScan, vertical_correction_deg: float) -> NDArray[np.float32]:
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    azimuth = np.where(azimuth < 0, azimuth + 2 * np.pi, azimuth)
    order = np.lexsort((azimuth, scan.ring))
    points = raise_elevation(scan.points[order], -vertical_correction_deg)
    return np.concatenate([points, scan.intensity[order, None]], 1).astype(np.float32)


def _camera_poses(sequence: Sequence, stamps: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Return the camera's poses in the frame of its first pose; None unless all are known."""
    truth: Trajectory | None = sequence.truth()
    if truth is None or not len(truth):
        return None
    T_imu_lidar = np.eye(4) if sequence.info.T_imu_lidar is None else sequence.info.T_imu_lidar
    known = truth.at(np.clip(stamps, truth.stamp_ns[0], truth.stamp_ns[-1]))
    beyond = np.maximum(truth.stamp_ns[0] - stamps, stamps - truth.stamp_ns[-1])
    # the middle of the first and of the last scan may be just outside a truth that covers the scans' ends
    # only
    if beyond.max() > _BEYOND_NS:
        return None
    lidar = known.poses @ T_imu_lidar
    return _T_CAM_LIDAR @ np.linalg.inv(lidar[0]) @ lidar @ np.linalg.inv(_T_CAM_LIDAR)
