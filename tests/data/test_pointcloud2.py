"""PointCloud2 layouts against the sweep they were written from, and against a byte-by-byte reader."""

import struct

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.pointcloud2 import decode_pointcloud2
from tests.data import bags
from tests.shared_data import SHARED_DATA, needs_shared

SEEN = bags.sweep()
OUSTER_BAG = SHARED_DATA / "ouster" / "os1_128_3scans.bag"

LAYOUTS = {
    "velodyne": (bags.VELODYNE, SEEN.time, "time"),
    "ouster": (bags.OUSTER, np.round(SEEN.time * 1e9), "t"),
    "hesai": (bags.HESAI, 1.7e9 + SEEN.time, "timestamp"),
    "robosense": (bags.ROBOSENSE, 1.7e9 + SEEN.time, "timestamp"),
    "livox": (bags.LIVOX_CLOUD, 1.7e18 + SEEN.time * 1e9, "timestamp"),
    "livox with offsets": (bags.LIVOX_OFFSET_CLOUD, np.round(SEEN.time * 1e9), "offset_time"),
}


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("row_padding", [0, 13])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_back_what_was_seen(layout: str, row_padding: int, big_endian: bool) -> None:
    dtype, ticks, field = LAYOUTS[layout]
    message = bags.cloud_message(
        bags.START_NS,
        bags.fill(dtype, SEEN, ticks),
        height=bags.RINGS,
        row_padding=row_padding,
        big_endian=big_endian,
    )
    cloud = decode_pointcloud2(message)
    assert cloud.stamp_ns == bags.START_NS
    assert cloud.points.dtype == np.float32
    assert cloud.points.flags.c_contiguous
    np.testing.assert_array_equal(cloud.points, SEEN.points)
    np.testing.assert_array_equal(cloud.ring, SEEN.ring)
    np.testing.assert_array_equal(cloud.intensity, SEEN.intensity)
    assert cloud.time_field == field
    assert cloud.time is not None
    np.testing.assert_array_equal(cloud.time, ticks.astype(dtype[field]))
    assert cloud.time_range == (cloud.time.min(), cloud.time.max())


@needs_shared
def test_a_real_ouster_message_equals_a_byte_by_byte_reading() -> None:
    from rosbags.rosbag1 import Reader
    from rosbags.typesys import Stores, get_typestore

    with Reader(OUSTER_BAG) as reader:
        connections = [c for c in reader.connections if c.topic == "/ouster/points"]
        raws = [raw for _, _, raw in reader.messages(connections)]
    types = get_typestore(Stores.ROS1_NOETIC)
    message = types.deserialize_ros1(raws[0], bags.CLOUD)
    cloud = decode_pointcloud2(message)
    data, kept = message.data.tobytes(), 0
    for number in range(0, 131072):
        x, y, z = struct.unpack_from("<fff", data, 48 * number)
        if x == y == z == 0.0:
            continue
        if kept % 997 == 0:
            assert cloud.points[kept].tolist() == [x, y, z]
            assert (cloud.intensity[kept],) == struct.unpack_from("<f", data, 48 * number + 16)
            assert (cloud.time[kept],) == struct.unpack_from("<I", data, 48 * number + 20)
            assert (cloud.ring[kept],) == struct.unpack_from("B", data, 48 * number + 26)
        kept += 1
    assert len(cloud.points) == kept


def test_nan_infinite_and_zero_points_are_dropped_together_with_their_fields() -> None:
    cloud = bags.fill(bags.VELODYNE, SEEN, SEEN.time)
    cloud["x"][3] = np.nan
    cloud["y"][10] = np.inf
    cloud["z"][11] = -np.inf
    for axis in "xyz":
        cloud[axis][20] = 0.0
    cloud["time"][30] = np.nan
    cloud["x"][40] = 0.0  # a real point on the plane x = 0
    decoded = decode_pointcloud2(bags.cloud_message(0, cloud))
    kept = np.delete(np.arange(len(cloud)), [3, 10, 11, 20, 30])
    np.testing.assert_array_equal(decoded.points[:, 2], cloud["z"][kept])
    np.testing.assert_array_equal(decoded.time, cloud["time"][kept])
    np.testing.assert_array_equal(decoded.ring, cloud["ring"][kept])


def test_firings_without_a_return_count_for_the_time_range_unless_zeroed() -> None:
    cloud = bags.fill(bags.HESAI, SEEN, 1.7e9 + SEEN.time)
    last, first = SEEN.time == SEEN.time.max(), SEEN.time == SEEN.time.min()
    for axis in "xyz":
        cloud[axis][last | first] = 0.0
    cloud["timestamp"][first] = 0.0
    decoded = decode_pointcloud2(bags.cloud_message(0, cloud))
    assert decoded.time_range == (1.7e9 + np.unique(SEEN.time)[1], 1.7e9 + SEEN.time.max())


def test_an_empty_cloud_decodes_to_no_points() -> None:
    decoded = decode_pointcloud2(bags.cloud_message(5, np.zeros(0, bags.VELODYNE)))
    assert decoded.points.shape == (0, 3)
    assert decoded.time_range is None


def test_coordinates_may_be_doubles_and_names_in_capitals() -> None:
    dtype = np.dtype([("X", "<f8"), ("Y", "<f8"), ("Z", "<f8"), ("Reflectivity", "<u2"), ("Channel", "<i4")])
    cloud = np.zeros(4, dtype)
    cloud["X"], cloud["Reflectivity"], cloud["Channel"] = [1, 2, 3, 4], 300, 7
    decoded = decode_pointcloud2(bags.cloud_message(0, cloud))
    np.testing.assert_array_equal(decoded.points[:, 0], [1, 2, 3, 4])
    assert set(decoded.intensity) == {300.0}
    assert decoded.ring is not None
    assert set(decoded.ring) == {7}
    assert decoded.time is None


def test_row_step_of_zero_is_understood() -> None:
    message = bags.cloud_message(0, bags.fill(bags.VELODYNE, SEEN, SEEN.time), height=bags.RINGS)
    message.row_step = 0
    np.testing.assert_array_equal(decode_pointcloud2(message).points, SEEN.points)


def test_rows_of_an_organised_cloud_stand_for_the_ring() -> None:
    cloud = bags.fill(bags.PLAIN, SEEN)
    decoded = decode_pointcloud2(bags.cloud_message(0, cloud, height=bags.RINGS))
    np.testing.assert_array_equal(decoded.ring, SEEN.ring)
    assert decoded.ring_source == "rows"
    transposed = cloud.reshape(bags.RINGS, bags.COLUMNS).T.ravel()
    decoded = decode_pointcloud2(bags.cloud_message(0, transposed, height=bags.COLUMNS))
    np.testing.assert_array_equal(decoded.ring, SEEN.ring.reshape(bags.RINGS, -1).T.ravel())
    assert decode_pointcloud2(bags.cloud_message(0, cloud)).ring is None


def test_livox_tags_that_mark_noise_are_dropped() -> None:
    cloud = bags.fill(bags.LIVOX_CLOUD, SEEN, 1.7e18 + SEEN.time * 1e9)
    cloud["tag"][:4] = [0x10, 0x20, 0x30, 0x0F]
    decoded = decode_pointcloud2(bags.cloud_message(0, cloud))
    np.testing.assert_array_equal(decoded.points, np.delete(SEEN.points, [1, 2], axis=0))


def test_the_time_field_can_be_named() -> None:
    dtype = np.dtype([*bags.PLAIN.descr, ("t", "<f4"), ("firing", "<u4")])
    cloud = np.zeros(3, dtype)
    cloud["x"], cloud["firing"] = 1.0, [5, 6, 7]
    decoded = decode_pointcloud2(bags.cloud_message(0, cloud), time_field="firing")
    np.testing.assert_array_equal(decoded.time, [5, 6, 7])
    with pytest.raises(LioJaxError, match=r"bag: topic /p.*config.data.time_field='tt'.*x, y, z, t, firing"):
        decode_pointcloud2(bags.cloud_message(0, cloud), time_field="tt", where="bag: topic /p")


def test_a_cloud_without_coordinates_names_its_fields() -> None:
    cloud = np.zeros(3, np.dtype([("x", "<f4"), ("y", "<f4"), ("depth", "<f4")]))
    with pytest.raises(LioJaxError, match=r"a.bag: topic /p.*no field 'z'.*x, y, depth"):
        decode_pointcloud2(bags.cloud_message(0, cloud), where="a.bag: topic /p")


def test_damaged_messages_raise_value_errors() -> None:
    cloud = bags.fill(bags.VELODYNE, SEEN, SEEN.time)
    short = bags.cloud_message(0, cloud)
    short.data = short.data[:-1]
    with pytest.raises(ValueError, match="1 x 1440 points of 22 bytes do not fit into 31679 bytes"):
        decode_pointcloud2(short)
    beyond = bags.cloud_message(0, cloud)
    beyond.fields[2].offset = 20
    with pytest.raises(ValueError, match="'z' lies beyond"):
        decode_pointcloud2(beyond)
    unknown = bags.cloud_message(0, cloud)
    unknown.fields[0].datatype = 77
    with pytest.raises(ValueError, match="'x' has the unknown datatype 77"):
        decode_pointcloud2(unknown)
