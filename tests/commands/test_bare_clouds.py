"""The recipe loam from clouds that carry neither ring nor time, from the bag to the run folder."""

from pathlib import Path

import numpy as np
import pytest

from lio_jax.data.trajectory import read_tum
from lio_jax.sim.sequence import SimulatedSequence
from tests.data.bag_recordings import cloud_messages
from tests.data.bags import PERIOD_NS, START_NS, write_bag

SCANS = 12
BARE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
SMALL = (
    "config.lidar.buckets=[32768]",
    "config.map.capacity=16384",
    "config.output.plot=false",
    "config.output.recording=false",
)


@pytest.fixture(scope="module")
def drive():
    return SimulatedSequence("street", "vlp16", SCANS / 10, seed=2, standstill_s=0.0)


@pytest.fixture(scope="module")
def bag(drive, tmp_path_factory) -> Path:
    """Return a bag of x, y, z and intensity alone, in the order of firing."""
    path = tmp_path_factory.mktemp("bare") / "bare.bag"
    clouds = []
    for scan in drive.scans():
        order = np.argsort(scan.time, kind="stable")
        cloud = np.zeros(len(scan.points), BARE)
        for axis, name in enumerate("xyz"):
            cloud[name] = scan.points[order, axis]
        clouds.append(cloud)
    return write_bag(path, cloud_messages(path, clouds))


@pytest.mark.long
def test_rings_and_times_are_reconstructed_and_the_drive_is_tracked(cli, bag, drive, tmp_path):
    done = cli("run", bag, "--recipe", "loam", "--out", tmp_path / "out", "--set", *SMALL)
    assert done.status == 0, done.err
    assert "ring: not recorded, reconstructed from elevation as of 16 beams" in done.err
    assert "per-point time: not recorded, reconstructed from azimuth" in done.err
    assert "config.features.rings=16" in done.err
    found = read_tum(tmp_path / "out" / "trajectory.tum")
    assert len(found) == SCANS
    np.testing.assert_allclose(found.stamp_ns, START_NS + PERIOD_NS * np.arange(1, SCANS + 1), atol=2e6)
    T_imu_lidar = drive.info.T_imu_lidar
    true = drive.poses(0.1 * np.arange(1, SCANS + 1)) @ T_imu_lidar
    expected = (np.linalg.inv(true[0]) @ true)[:, :3, 3]
    moved = (np.linalg.inv(found.poses[0]) @ found.poses)[:, :3, 3]
    assert np.linalg.norm(moved - expected, axis=1).max() < 0.1


def test_a_number_of_beams_that_does_not_fit_is_refused(cli, bag, tmp_path):
    done = cli(
        "run", bag, "--recipe", "loam", "--out", tmp_path / "out", "--set", "config.data.beams=64", *SMALL
    )
    assert done.status == 2
    assert "config.data.beams=64 beams from -24.3 to 2.0 deg do not fit the points" in done.err
    assert "in 16 levels, suggest config.data.beams=16" in done.err
    assert not (tmp_path / "out").exists()
