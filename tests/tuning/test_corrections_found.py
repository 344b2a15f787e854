"""Corrections of a sensor's calibration are found without truth, from the recording that it distorts."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from lio_jax.cli import main
from lio_jax.data.native_writer import write_native
from lio_jax.sim.sequence import SimulatedSequence

ELEVATION, RANGE = np.radians(0.3), 0.05


def distorted(scan):
    """Return a scan as a sensor reports it whose elevations and ranges are too small."""
    x, y, z = scan.points.astype(float).T
    azimuth, distance = np.arctan2(y, x), np.sqrt(x**2 + y**2 + z**2)
    elevation = np.arcsin(z / distance) - ELEVATION
    level = (distance - RANGE) * np.cos(elevation)
    height = (distance - RANGE) * np.sin(elevation)
    points = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=1)
    return replace(scan, points=points.astype(np.float32))


@pytest.mark.long
def test_elevation_and_range_offsets_are_found_by_the_blur_of_the_map(tmp_path):
    drive = SimulatedSequence(duration_s=10.0, seed=1, moving_start=True)
    write_native(
        tmp_path / "drive", (distorted(scan) for scan in drive.scans()), T_imu_lidar=drive.info.T_imu_lidar
    )
    free, out = "lidar.elevation_offset,lidar.range_offset", tmp_path / "out"
    words = ["tune", str(tmp_path / "drive"), "--params", free, "--objective", "map", "--out", str(out)]
    assert main(words) == 0
    found = yaml.safe_load((out / "tuned.yaml").read_text())["params"]["lidar"]
    assert found["elevation_offset"] == pytest.approx(ELEVATION, rel=0.05)
    assert found["range_offset"] == pytest.approx(RANGE, rel=0.05)
