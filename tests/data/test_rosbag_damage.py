"""Every fault of a bag is reported in one sentence; the messages before it are read."""

import re
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.rosbag import RosbagSequence
from tests.data import bags
from tests.data.bag_recordings import (
    AUTO,
    FORMATS,
    cloud_messages,
    imu_messages,
    in_order,
    scan_starts,
    storage_file,
)


def test_a_message_that_cannot_be_decoded_is_skipped(tmp_path: Path) -> None:
    messages = bags.velodyne_messages(4, ros2=False)
    messages[1][2].width += 1
    sequence = RosbagSequence(bags.write_bag(tmp_path / "a.bag", messages), AUTO)
    assert [scan.stamp_ns for scan in sequence.scans()] == [scan_starts(4)[k] for k in (0, 2, 3)]
    (warning,) = sequence.warnings_so_far
    assert warning.startswith("a.bag: scan 1 cannot be read and was skipped: 1 x 1441 points of 22 bytes")


def test_only_messages_that_cannot_be_decoded(tmp_path: Path) -> None:
    messages = bags.velodyne_messages(2, ros2=False)
    for message in messages:
        message[2].width += 1
    path = bags.write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(
        LioJaxError, match=r"a.bag: topic /points: no point cloud can be read \(1 x 1441 points"
    ):
        RosbagSequence(path, AUTO)


def test_a_cloud_without_coordinates(tmp_path: Path) -> None:
    cloud = np.zeros(4, np.dtype([("range", "<f4"), ("x", "<f4")]))
    path = bags.write_bag(tmp_path / "a.bag", cloud_messages(tmp_path / "a.bag", [cloud]))
    with pytest.raises(LioJaxError, match=r"a.bag: topic /points.*no field 'y' or 'z'.*range, x"):
        RosbagSequence(path, AUTO)


def _many(path: Path, count: int) -> list[bags.Message]:
    """Return noise that does not compress, so that chunks of the file belong to few scans each."""
    rng = np.random.default_rng(0)
    clouds = []
    for _ in range(count):
        cloud = np.zeros(20_000, bags.VELODYNE)
        for axis in "xyz":
            cloud[axis] = rng.normal(size=cloud.size)
        cloud["time"] = np.linspace(0.0, 0.099, cloud.size)
        clouds.append(cloud)
    return cloud_messages(path, clouds)


def _spoil(file: Path, name: str) -> None:
    """Damage what the index of the file does not cover, in the middle of its data."""
    data = bytearray(file.read_bytes())
    middle = int(0.6 * len(data))
    if name.endswith(".bag"):
        for record in re.finditer(rb"op=\x02", bytes(data[middle : middle + 600_000])):
            data[middle + record.start() : middle + record.end()] = b"\xff" * 4
    elif name.endswith(".mcap"):
        data[middle : middle + 200_000] = bytes(200_000)
    else:
        # A page of a blob begins with the number of the next one; a page of the table with its kind, 13.
        page = next(p for p in range(middle // 4096 * 4096, len(data), 4096) if data[p] == 0)
        data[page : page + 4] = b"\xff\xff\xff\xff"
    file.write_bytes(data)


@pytest.mark.parametrize("name", FORMATS)
def test_damage_in_the_middle_ends_the_scans_with_a_warning(tmp_path: Path, name: str) -> None:
    messages = in_order(_many(tmp_path / name, 30) + imu_messages(300, bags.is_ros2(tmp_path / name)))
    path = bags.write_bag(tmp_path / name, messages, compressed=name.endswith(".mcap"))
    _spoil(storage_file(path), name)
    sequence = RosbagSequence(path, AUTO)
    stamps = [scan.stamp_ns for scan in sequence.scans()]
    assert 10 < len(stamps) < 25
    assert stamps == scan_starts(30)[: len(stamps)]
    (warning,) = sequence.warnings_so_far
    assert f"the bag is damaged after scan {len(stamps) - 1} of 30 (" in warning
    assert warning.startswith(str(path))


def test_damage_keeps_the_inertial_samples_before_it(tmp_path: Path) -> None:
    messages = in_order(_many(tmp_path / "a.mcap", 30) + imu_messages(300, ros2=True))
    path = bags.write_bag(tmp_path / "a.mcap", messages, compressed=True)
    _spoil(storage_file(path), "a.mcap")
    sequence = RosbagSequence(path, AUTO)
    inertial = sequence.imu()
    assert inertial is not None
    assert 100 < len(inertial.stamp_ns) < 250
    assert "IMU and GPS samples end there" in sequence.warnings_so_far[0]
