"""Single files, compressed, split and large bags read as one recording."""

import gc
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lio_jax.data import rosbag
from lio_jax.data.rosbag import RosbagSequence
from tests.data import bags
from tests.data.bag_recordings import (
    AUTO,
    FORMATS,
    SEEN,
    check_seen,
    imu_messages,
    received,
    scan_starts,
    storage_file,
)


def test_storage_files_open_alone(tmp_path: Path) -> None:
    for name, suffix in (("a.db3", ".db3"), ("b.mcap", ".mcap")):
        folder = bags.write_bag(tmp_path / name, bags.velodyne_messages(3))
        file = next(folder.glob(f"*{suffix}"))
        for path in (file, folder / "metadata.yaml"):
            assert [scan.stamp_ns for scan in RosbagSequence(path, AUTO).scans()] == scan_starts(3)
        (folder / "metadata.yaml").unlink()
        assert [scan.stamp_ns for scan in RosbagSequence(folder, AUTO).scans()] == scan_starts(3)


def test_a_database_without_message_definitions(tmp_path: Path) -> None:
    """ROS 2 before Iron stored no definitions: the types rosbags knows must do, and Livox needs none."""
    import sqlite3

    seen = bags.fill(bags.LIVOX_OFFSET_CLOUD, SEEN, np.round(SEEN.time * 1e9))
    livox = [("/livox", received(stamp), bags.custom_message(stamp, seen, True)) for stamp in scan_starts(2)]
    for name, messages in (("a.db3", bags.velodyne_messages(2) + imu_messages(5, True)), ("b.db3", livox)):
        folder = bags.write_bag(tmp_path / name, messages)
        file = next(folder.glob("*.db3"))
        with sqlite3.connect(file) as database:
            database.executescript("DROP TABLE message_definitions; DROP TABLE schema;")
        database.close()
        sequence = RosbagSequence(file, AUTO)
        assert [scan.stamp_ns for scan in sequence.scans()] == scan_starts(2)
        imu = sequence.imu()
        assert imu is None or len(imu.stamp_ns) == 5


@pytest.mark.parametrize("name", FORMATS)
def test_compressed_bags(tmp_path: Path, name: str) -> None:
    messages = bags.velodyne_messages(3, bags.is_ros2(tmp_path / name))
    path = bags.write_bag(tmp_path / name, messages, compressed=True)
    for scan, stamp in zip(RosbagSequence(path, AUTO).scans(), scan_starts(3), strict=True):
        check_seen(scan, stamp)


def test_split_bags_of_one_recording(tmp_path: Path) -> None:
    for number in range(3):
        bags.write_bag(
            tmp_path / f"split_{number}.bag", bags.velodyne_messages(2, ros2=False, first=2 * number)
        )
    bags.write_bag(tmp_path / "imu.bag", imu_messages(7, ros2=False))
    sequence = RosbagSequence(tmp_path, AUTO)
    assert sequence.info.scan_count == 6
    assert sequence.info.notes[0] == "4 files read as one recording"
    assert [scan.stamp_ns for scan in sequence.scans()] == scan_starts(6)
    imu = sequence.imu()
    assert imu is not None
    assert len(imu.stamp_ns) == 7


def test_start_and_count_skip_without_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bags.write_bag(tmp_path / "a.bag", bags.velodyne_messages(8, ros2=False))
    sequence = RosbagSequence(path, AUTO)
    decoded = []
    real = rosbag.decode_cloud
    monkeypatch.setattr(rosbag, "decode_cloud", lambda *args: decoded.append(1) or real(*args))
    assert [scan.stamp_ns for scan in sequence.scans(5, 2)] == scan_starts(8)[5:7]
    assert len(decoded) == 2
    assert list(sequence.scans(8)) == []
    assert list(sequence.scans(2, 0)) == []
    assert len(list(sequence.scans(6))) == 2
    list(sequence.header_stamps())
    assert len(decoded) == 4


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def _big(path: Path, megabytes: int) -> Iterator[bags.Message]:
    cloud = bags.fill(bags.OUSTER, bags.sweep(64, 1024), np.round(bags.sweep(64, 1024).time * 1e9))
    message = bags.cloud_message(bags.START_NS, cloud, bags.is_ros2(path))
    number = 0
    while number * message.data.nbytes < megabytes * 1e6:
        stamp = bags.START_NS + number * bags.PERIOD_NS
        message.header = bags.header(stamp, bags.is_ros2(path))
        yield "/points", received(stamp), message
        number += 1


@pytest.mark.parametrize(("name", "megabytes"), [("a.bag", 200), ("a.db3", 80), ("a.mcap", 80)])
def test_memory_stays_flat_while_streaming(tmp_path: Path, name: str, megabytes: int) -> None:
    path = bags.write_bag(tmp_path / name, _big(tmp_path / name, megabytes))
    assert storage_file(path).stat().st_size > megabytes * 1e6
    sequence = RosbagSequence(path, AUTO)
    for _ in sequence.scans(0, 3):
        pass
    gc.collect()
    before = resident = _resident_mb()
    tracemalloc.start()
    try:
        count = 0
        for scan in sequence.scans():
            count += 1
            assert len(scan.points) == 65_536
            resident = max(resident, _resident_mb())
        peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert count == sequence.info.scan_count
    assert peak_mb < 30
    assert resident - before < 40
