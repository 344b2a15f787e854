"""Run folders made by hand, as ``lio-jax run`` leaves them, without running anything."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from pypcd4 import PointCloud
from scipy.spatial.transform import Rotation

from lio_jax.data.trajectory import Trajectory, write_tum
from lio_jax.settings.settings import recipe_settings

START_NS = 1_700_000_000_000_000_000


def poses_on_a_curve(count: int) -> np.ndarray:
    """A bend of 40 m radius, 1 m a scan, that climbs."""
    angle = np.arange(count) / 40.0
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", angle[:, None]).as_matrix()
    poses[:, :3, 3] = np.c_[40 * np.sin(angle), 40 * (1 - np.cos(angle)), 0.02 * np.arange(count)]
    return poses


def write_run(
    folder: Path,
    count: int = 60,
    *,
    name: str = "a drive",
    inertial: bool = True,
    truth: bool = True,
    changes: dict[str, Any] | None = None,
    metrics: dict[str, Any] | None = None,
) -> Path:
    """Write a run folder whose position errors are 0.1 m in x at every second scan.

    Args:
        folder: to make.
        count: scans.
        name: of the recording.
        inertial: of a recipe that carries covariance and innovations.
        truth: whether truth.tum is there.
        changes: settings by path that differ from the recipe's own.
        metrics: entries of metrics.json that differ.
    """
    folder.mkdir(parents=True)
    generator = np.random.default_rng(3)
    stamps = START_NS + np.arange(count) * 100_000_000
    true = poses_on_a_curve(count)
    poses = true.copy()
    poses[::2, 0, 3] += 0.1
    states: dict[str, Any] = {
        "stamps_ns": stamps,
        "poses": poses,
        "velocity": np.tile([10.0, 0.0, 0.0], (count, 1)),
        "biases": np.tile([0.01, 0.02, 0.03, 0.1, 0.2, 0.3], (count, 1)) * inertial,
        "covariance": np.tile(np.diag([1e-6] * 3 + [1e-4] * 3), (count, 1, 1)),
        "nis": np.where(np.arange(count) % 10 == 0, 30.0, 6.0) * inertial,
        "nis_dof": np.full(count, 6 * inertial),
    }
    if inertial:
        states["state_covariance"] = np.tile(np.diag(np.full(24, 1e-4)), (count, 1, 1))
    np.savez(folder / "states.npz", **states)
    failed = np.arange(count) == 7
    scans: dict[str, Any] = {
        "scan": np.arange(count),
        "points": np.full(count, 20_000),
        "matches": np.full(count, 1_500),
        "rmse": np.full(count, 0.03),
        "iterations": np.full(count, 4),
        "unobserved": np.zeros(count, int),
        "lost": failed,
        "failed": failed,
        **{f"{stage}_ms": generator.uniform(1, 9, count) for stage in ("decode", "pad", "step", "record")},
        "total_ms": generator.uniform(5, 15, count),
    }
    np.savez(folder / "scans.npz", **scans)
    if truth:
        write_tum(folder / "truth.tum", Trajectory(stamps, true))
    cloud = generator.uniform([-50, -50, 0], [50, 50, 5], (5000, 3)).astype(np.float32)
    PointCloud.from_xyz_points(cloud).save(folder / "map.pcd")
    settings = recipe_settings("default")
    for path, value in (changes or {}).items():
        settings = settings.with_value(path, value, "test")
    (folder / "config.yaml").write_text(settings.to_yaml())
    said: dict[str, Any] = {
        "recording": {
            "name": name,
            "path": f"/data/{name}",
            "format": "native",
            "sensor": "made",
            "notes": [],
        },
        "scans": count,
        "prediction": "inertial samples",
        "scan_ms": {"total": {"median": 10.0, "p95": 14.0, "p99": 15.0}},
        "compile_s": 1.5,
        "wall_s": 3.25,
        "peak_rss_mb": 512.0,
        "failures": [{"scan": 7, "stamp_ns": int(stamps[7]), "message": "scan 7: 3 points matched the map."}],
        "warnings": ["the clock stepped back."],
        "notes": ["T_imu_lidar: from the recording."],
        "environment": {"jax": "0.10.2", "processor": "made"},
        "ate": {"rmse": 0.05, "mean": 0.05, "max": 0.05},
    }
    (folder / "metrics.json").write_text(json.dumps(said | (metrics or {})))
    return folder
