"""A single wrong stamp costs its own scan and no other, in every format."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.native_writer import write_native
from tests.data import bags
from tests.data.bag_recordings import SEEN, received, scan_starts
from tests.data.test_kitti import write_sequence
from tests.data.test_kitti_raw import stamps, write_drive
from tests.data.test_native import scan_number

WRONG = 2
AHEAD_S = 1e6


def write_kitti(path: Path) -> Path:
    times = [0.1 * number for number in range(6)]
    times[WRONG] += AHEAD_S
    folder = write_sequence(path, 6, "\n".join(map(str, times)))
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 6)
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    return folder


def write_kitti_raw(path: Path) -> Path:
    folder = write_drive(path, 6)
    times = [0.1 * number for number in range(6)]
    times[WRONG] = 20.0
    for file in ("velodyne_points/timestamps_start.txt", "oxts/timestamps.txt"):
        (folder / file).write_text(stamps(*times))
    (folder / "velodyne_points" / "timestamps_end.txt").write_text(stamps(*(time + 0.1 for time in times)))
    return folder


def write_folder(path: Path) -> Path:
    scans = [scan_number(number) for number in range(6)]
    scans[WRONG] = replace(scans[WRONG], stamp_ns=scans[WRONG].stamp_ns + round(AHEAD_S * 1e9))
    write_native(path / "s", scans)
    return path / "s"


def write_bag(path: Path) -> Path:
    starts = scan_starts(6)
    headers = starts.copy()
    headers[WRONG] += round(AHEAD_S * 1e9)
    cloud = bags.fill(bags.VELODYNE, SEEN, SEEN.time)
    messages = [
        ("/points", received(start), bags.cloud_message(header, cloud, False))
        for start, header in zip(starts, headers, strict=True)
    ]
    return bags.write_bag(path / "a.bag", messages)


@pytest.mark.parametrize("write", [write_kitti, write_kitti_raw, write_folder, write_bag])
def test_only_the_scan_with_the_wrong_stamp_is_dropped(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    sequence = open_sequence(write(tmp_path), DataConfig())
    kept = [scan.stamp_ns for scan in sequence.scans()]
    assert len(kept) == 5
    steps = np.diff(kept) * 1e-9
    np.testing.assert_allclose(steps, [0.1, 0.2, 0.1, 0.1], atol=1e-6)
    (warning,) = sequence.warnings_so_far
    assert f"{WRONG}" in Path(warning.split(" (")[0]).name
    assert "ahead of" in warning
    assert warning.endswith("a wrong stamp, skipped.")


def test_a_wrong_time_of_a_kitti_scan_is_no_time_of_its_true_pose(tmp_path: Path) -> None:
    truth = open_sequence(write_kitti(tmp_path)).truth()
    assert truth is not None
    assert truth.stamp_ns.tolist() == [0, 100_000_000, 300_000_000, 400_000_000, 500_000_000]
    assert len(truth.at(truth.stamp_ns)) == 5


def test_a_wrong_oxts_stamp_costs_one_packet(tmp_path: Path) -> None:
    sequence = open_sequence(write_kitti_raw(tmp_path))
    imu = sequence.imu()
    assert imu is not None
    assert len(imu.stamp_ns) == 5
    assert any("1 packet(s) whose stamp does not ascend" in warning for warning in sequence.warnings_so_far)
