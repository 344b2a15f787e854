"""``lio-jax export``: what is written reads back as what it was."""

from pathlib import Path

import jax
import numpy as np
import pytest

from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.native_writer import write_native
from lio_jax.data.trajectory import read_tum
from lio_jax.run.scan_inputs import ImuFeed
from lio_jax.sim.gps import GpsModel
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence

SCANS = 4


def read(path: Path, **config):
    sequence = open_sequence(path, DataConfig(**config))
    return sequence, list(sequence.scans())


def in_order(scan) -> np.ndarray:
    """Return x, y, z, intensity and ring of a scan's points in an order of their own."""
    azimuth = np.round(np.arctan2(scan.points[:, 1], scan.points[:, 0]), 4)
    order = np.lexsort((np.linalg.norm(scan.points, axis=1), azimuth, scan.ring))
    return np.column_stack([scan.points, scan.intensity, scan.ring])[order]


@pytest.fixture(scope="module")
def original(folder):
    return read(folder)


@pytest.mark.parametrize("ending", ["bag", "mcap"])
def test_a_bag_holds_the_scans_and_has_the_truth_beside_it(cli, folder, original, tmp_path, ending):
    out = tmp_path / f"drive.{ending}"
    done = cli("export", folder, "--to", "bag", "--out", out, "--scans", SCANS)
    assert done.status == 0, done.err
    assert f"scans      {SCANS}" in done.out
    _, scans = read(out)
    assert len(scans) == SCANS
    for one, other in zip(scans, original[1], strict=False):
        assert abs(one.stamp_ns - other.stamp_ns) < 1000
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.ring, other.ring)
        np.testing.assert_allclose(one.time, other.time, atol=2e-6)
    truth, whole = read_tum(tmp_path / "drive.truth.tum"), original[0].truth()
    np.testing.assert_allclose(truth.poses, whole.poses[: len(truth)], atol=1e-6)
    assert truth.stamp_ns[-1] >= scans[-1].end_ns - 1000


def test_a_native_folder_is_the_same_recording(cli, folder, original, tmp_path):
    out = tmp_path / "again"
    assert cli("export", folder, "--to", "native", "--out", out, "--start", 1, "--scans", SCANS).status == 0
    sequence, scans = read(out)
    assert len(scans) == SCANS
    for one, other in zip(scans, original[1][1:], strict=False):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.time, other.time)
    whole, truth = original[0].truth(), sequence.truth()
    places = np.searchsorted(whole.stamp_ns, truth.stamp_ns)
    np.testing.assert_allclose(truth.poses, whole.poses[places], atol=1e-9)


def test_a_part_holds_the_samples_of_its_own_time(cli, tmp_path):
    whole = SimulatedSequence(duration_s=5.0, beams=16, columns=128, imu=ImuModel(), gps=GpsModel())
    source, out = tmp_path / "whole", tmp_path / "part"
    parts = {"imu": whole.imu(), "gps": whole.gps(), "truth": whole.truth()}
    write_native(source, whole.scans(), T_imu_lidar=whole.info.T_imu_lidar, **parts)
    assert cli("export", source, "--to", "native", "--out", out, "--start", 20, "--scans", 4).status == 0
    sequence, scans = read(out)
    before, scans_before = read(source)
    begin, end = scans_before[20].stamp_ns - 1e9, scans_before[23].end_ns + 1e9
    for part, all_of_it in (
        (sequence.imu(), before.imu()),
        (sequence.gps(), before.gps()),
        (sequence.truth(), before.truth()),
    ):
        kept = (all_of_it.stamp_ns >= begin) & (all_of_it.stamp_ns <= end)
        assert 0 < kept.sum() < len(kept)
        np.testing.assert_array_equal(part.stamp_ns, all_of_it.stamp_ns[kept])
    # the estimator gets the same samples as from the whole recording
    part_feed, whole_feed = (ImuFeed(one.imu(), (64, 256, 1024)) for one in (sequence, before))
    last_end = scans_before[19].end_ns
    for number, scan in enumerate(scans):
        own, same = scans_before[20 + number], np.testing.assert_array_equal
        jax.tree.map(same, part_feed.before(scan), whole_feed.before(own))
        jax.tree.map(same, part_feed.batch(scan, last_end), whole_feed.batch(own, last_end))
        last_end = scan.end_ns


def test_a_kitti_sequence_keeps_points_rings_times_and_poses(cli, folder, original, tmp_path):
    out = tmp_path / "99"
    done = cli("export", folder, "--to", "kitti", "--out", out)
    assert done.status == 0, done.err
    assert "--set config.data.compensated=no" in done.out
    before, whole = original
    sequence, scans = read(out, compensated="no", scan_period=whole[0].duration)
    assert len(scans) == len(whole)
    for one, other in zip(scans, whole, strict=True):
        # stamps count from the first scan's middle
        middle = whole[0].stamp_ns + round(whole[0].duration * 0.5e9)
        assert abs(one.stamp_ns + middle - other.stamp_ns) < 1000
        np.testing.assert_allclose(in_order(one), in_order(other), atol=2e-4)
    truth = before.truth().times_body(before.info.T_imu_lidar)
    middles = np.array([scan.stamp_ns + round(scan.duration * 0.5e9) for scan in whole])
    known = truth.at(np.clip(middles, truth.stamp_ns[0], truth.stamp_ns[-1])).poses
    np.testing.assert_allclose(sequence.truth().poses, np.linalg.inv(known[0]) @ known, atol=1e-5)


def test_kitti_to_bag_and_back(cli, tmp_path):
    source = Path(__file__).resolve().parents[2].parent / "shared/data/kitti_odometry/sequences/04"
    if not source.is_dir():
        pytest.skip(f"{source} is not there")
    bag, back = tmp_path / "04.bag", tmp_path / "04"
    assert cli("export", source, "--to", "bag", "--out", bag, "--scans", 2).status == 0
    words = ("export", bag, "--to", "kitti", "--out", back, "--set", "config.data.compensated=yes")
    assert cli(*words).status == 0
    first, again = read(source)[0].scans(0, 2), read(back)[1]
    for one, other in zip(again, first, strict=True):
        assert one.duration == other.duration == 0
        assert one.stamp_ns == other.stamp_ns
        # a point straight ahead may be rounded across the seam of two rings
        np.testing.assert_allclose(np.bincount(one.ring), np.bincount(other.ring), atol=2)
        apart = np.sort(np.linalg.norm(one.points, axis=1)) - np.sort(np.linalg.norm(other.points, axis=1))
        assert np.abs(apart).max() < 1e-4


def test_poses_come_out_as_they_went_in(cli, tmp_path):
    source = Path(__file__).resolve().parents[2].parent / "shared/data/kitti_odometry/sequences/04"
    if not source.is_dir():
        pytest.skip(f"{source} is not there")
    assert cli("export", source, "--to", "kitti", "--out", tmp_path / "04", "--scans", 3).status == 0
    again, expected = read(tmp_path / "04")[0].truth(), read(source)[0].truth()
    np.testing.assert_allclose(again.poses, expected.poses[:3], atol=1e-6)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--to", "bag", "--out", "drive"), "a bag's name ends in .bag, .db3, .mcap"),
        (("--to", "kitti", "--out", "drive.bag"), "--to kitti writes a folder"),
        (("--to", "bag", "--out", "x.bag", "--layout", "hesai"), "point layout 'hesai' is unknown"),
        (("--to", "native", "--out", "x", "--scans", "0"), "--scans 1 or more"),
        (("--to", "native", "--out", "x", "--start", "99999"), "start at"),
    ],
)
def test_mistakes_are_said_in_a_sentence_and_leave_nothing(
    cli, folder, tmp_path, monkeypatch, words, complaint
):
    monkeypatch.chdir(tmp_path)
    done = cli("export", folder, *words)
    assert done.status == 2
    assert complaint in done.err
    assert "Traceback" not in done.err
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_replaced_on_demand_only(cli, folder, tmp_path):
    out = tmp_path / "99"
    words = ("export", folder, "--to", "kitti", "--out", out, "--scans", 2)
    assert cli(*words).status == 0
    assert cli(*words).status == 2
    assert cli(*words, "--overwrite").status == 0
    other = tmp_path / "other"
    other.mkdir()
    (other / "precious.txt").write_text("mine")
    assert cli("export", folder, "--to", "kitti", "--out", other, "--overwrite").status == 2
    assert (other / "precious.txt").read_text() == "mine"
