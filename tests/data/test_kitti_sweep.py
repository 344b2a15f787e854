"""Which way and from where KITTI's HDL-64E turns, judged by the world being rigid."""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lio_jax.data.config import DataConfig
from lio_jax.data.kitti_raw import KittiRawSequence
from tests.shared_data import SHARED_DATA, needs_shared

TURNING = SHARED_DATA / "kitti_raw" / "2011_09_26" / "2011_09_26_drive_0005_sync"


def thinned(points: np.ndarray, size: float) -> np.ndarray:
    _, first = np.unique(np.floor(points / size).astype(int), axis=0, return_index=True)
    return points[first]


def matched_residual(target: np.ndarray, source: np.ndarray, guess: np.ndarray) -> float:
    """Point-to-plane ICP from ``guess``; the median distance of what matched, m."""
    target, source, pose = thinned(target, 0.2), thinned(source, 1.0), guess.copy()
    tree = cKDTree(target)
    distance = np.zeros(1)
    for _ in range(10):
        moved = source @ pose[:3, :3].T + pose[:3, 3]
        near, index = tree.query(moved, k=10)
        cell = target[index]
        mean = cell.mean(axis=1)
        spread = np.einsum("kij,kil->kjl", cell - mean[:, None], cell - mean[:, None]) / 10
        values, vectors = np.linalg.eigh(spread)
        normal = vectors[:, :, 0]
        distance = np.einsum("ij,ij->i", normal, moved - mean)
        flat = (values[:, 0] < 0.05**2) & (values[:, 1] > 4 * values[:, 0])
        use = flat & (near[:, 0] < 0.5) & (np.abs(distance) < 0.3)
        rows, distance = np.c_[np.cross(moved, normal), normal][use], distance[use]
        weight = 1.0 / (1.0 + (distance / 0.05) ** 2) ** 2
        step = -np.linalg.solve(rows.T @ (rows * weight[:, None]), rows.T @ (weight * distance))
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
        pose = change @ pose
    return float(np.median(np.abs(distance)))


@needs_shared
def test_real_scans_match_best_when_swept_clockwise_from_behind() -> None:
    """Compensate two scans 2 s apart, in the turn, by the INS's twist under each hypothesis of the sweep."""
    sequence = KittiRawSequence(TURNING, DataConfig())
    T_imu_lidar, truth = sequence.info.T_imu_lidar, sequence.truth()
    assert T_imu_lidar is not None
    assert truth is not None
    scans = [next(sequence.scans(number, 1)) for number in (25, 45)]

    def residual(fraction_of: dict[str, float]) -> float:
        clouds, poses = [], []
        for scan in scans:
            ends = np.array([scan.stamp_ns, (scan.stamp_ns + scan.end_ns) // 2, scan.end_ns])
            start, middle, end = truth.times_body(T_imu_lidar).at(ends).poses
            change = np.linalg.inv(start) @ end
            turn, shift = Rotation.from_matrix(change[:3, :3]).as_rotvec(), change[:3, 3]
            distance = np.linalg.norm(scan.points, axis=1)
            points = scan.points[(distance > 3) & (distance < 50)].astype(float)
            time = scan.time[(distance > 3) & (distance < 50)] / scan.duration
            share = (
                (fraction_of["sign"] * time + fraction_of["shift"]) % 1.0 - 0.5 if fraction_of else 0.0 * time
            )
            clouds.append(Rotation.from_rotvec(share[:, None] * turn).apply(points) + share[:, None] * shift)
            poses.append(middle)
        return matched_residual(clouds[0], clouds[1], np.linalg.inv(poses[0]) @ poses[1])

    as_read = residual({"sign": 1.0, "shift": 0.0})
    assert as_read < 0.95 * residual({})
    assert as_read < 0.95 * residual({"sign": -1.0, "shift": 0.0})
    assert as_read < 0.95 * residual({"sign": 1.0, "shift": 0.5})
