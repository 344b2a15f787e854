"""Scans with rings: made up, and the real ones."""

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from lio_jax.core.types import Scan
from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.sequence import LidarScan
from lio_jax.lidar.params import LoamRingConfig, ScanConfig
from lio_jax.run.scan_inputs import padded
from tests.params import DEFAULTS, Config, Params, params_from_values
from tests.shared_data import SHARED_DATA

RECORDINGS = {
    "kitti_odometry_04": "kitti_odometry/sequences/04",
    "kitti_raw_0005": "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync",
    "kitti_raw_0060": "kitti_raw/2011_09_26/2011_09_26_drive_0060_sync",
    "ouster_os1_128": "ouster/os1_128_3scans.bag",
    "newer_college": "newer_college",
}
"""Real recordings with beams, by name."""


def config_of(**features) -> Config:
    return Config(features=LoamRingConfig(**features))


def params_of(**leaves: float) -> Params:
    """Return default parameters with some values replaced, for example ``features__corner_threshold``."""
    values = {section: dict(entries) for section, entries in DEFAULTS.items()}
    for path, value in leaves.items():
        section, name = path.split("__")
        values[section][name] = value
    return params_from_values(values)


LOAM_PARAMS = params_of(lidar__min_range=0.3)
LIO_SAM_PARAMS = params_of(
    lidar__min_range=1.0,
    lidar__max_range=1000.0,
    features__corner_threshold=1.0,
    features__surface_spacing=0.4,
)


def scan_of(points: np.ndarray, ring: np.ndarray, time: np.ndarray | None = None, size: int = 0) -> Scan:
    """Return a padded scan of 0.1 s."""
    count = len(points)
    time = np.linspace(0.0, 0.1, count) if time is None else time
    recorded = LidarScan(
        stamp_ns=0,
        points=np.asarray(points, np.float32),
        time=np.asarray(time, np.float32),
        ring=np.asarray(ring, np.int32),
        intensity=np.zeros(count, np.float32),
        duration=0.1,
    )
    return on_device(padded(recorded, None, ScanConfig(), size or None))


def on_device(scan: Scan) -> Scan:
    return jax.tree.map(jnp.asarray, scan)


def random_scan(seed: int = 0, rings: int = 8, count: int = 3000, order: str = "firing") -> Scan:
    """Return a scan of a bumpy world, with points missing, NaN, too near and too far."""
    rng = np.random.default_rng(seed)
    steps = np.arange(count // rings)
    azimuth, ring = np.meshgrid(-2 * np.pi * steps / steps.size + 2.0, np.arange(rings), indexing="ij")
    if order == "rings":
        azimuth, ring = azimuth.T, ring.T
    azimuth, ring = azimuth.ravel(), ring.ravel()
    walls = 10 + 6 * np.sign(np.sin(5 * azimuth + ring)) + 2 * np.cos(3 * azimuth)
    distance = walls + rng.normal(0, 0.02, azimuth.size)
    elevation = np.radians(-15 + 30 * ring / rings)
    flat = distance * np.cos(elevation)
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], -1)
    fate = rng.uniform(size=azimuth.size)
    points[fate < 0.02] = np.nan
    points[(fate > 0.02) & (fate < 0.03)] = np.inf
    points[(fate > 0.03) & (fate < 0.04)] *= 1e-3
    points[(fate > 0.04) & (fate < 0.05)] *= 1e4
    kept = (fate < 0.9) & (ring != 3)
    return scan_of(points[kept], ring[kept])


def real_scans(name: str) -> Iterator[tuple[LidarScan, int]]:
    """Yield a recording's scans and their number of rings."""
    path = SHARED_DATA / RECORDINGS[name]
    if name == "newer_college":
        for number in range(3):
            yield _newer_college(path, number), 64
        return
    for scan in open_sequence(path, DataConfig()).scans():
        yield scan, 128 if name.startswith("ouster") else 64


def _newer_college(folder: Path, number: int) -> LidarScan:
    """Return a thinned sweep of an OS1-64: 64 beams about 0.53 deg apart, recognised by their elevation."""
    points = np.fromfile(folder / f"raw_{number:02d}.bin", np.float32).reshape(-1, 3)
    time = np.fromfile(folder / f"times_{number:02d}.bin", np.float32)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    ring = np.clip(np.rint((elevation + 15.6) / (33.34 / 63)), 0, 63).astype(np.int32)
    return LidarScan(0, points, time, ring, np.zeros(len(points), np.float32), 0.1)
