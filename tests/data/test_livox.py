"""The direct CustomMsg reader against rosbags' generic decoder."""

from typing import Any

import numpy as np
import pytest

from lio_jax.data.cloud_fields import keep_by_tag
from lio_jax.data.pointcloud2 import LIVOX_TYPES, decode_custom_msg
from tests.data import bags

SEEN = bags.sweep(columns=20)


def _cloud(count: int = 320) -> np.ndarray:
    cloud = bags.fill(bags.LIVOX_OFFSET_CLOUD, SEEN, np.round(SEEN.time * 1e9))[:count]
    cloud["tag"] = np.random.default_rng(0).integers(0, 256, len(cloud))
    return cloud


def _raw(message: Any, ros2: bool, order: str = "<") -> bytes:
    types, kind = bags.store(ros2), message.__msgtype__
    if not ros2:
        return bytes(types.serialize_ros1(message, kind))
    return bytes(types.serialize_cdr(message, kind, little_endian=order == "<"))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("ros2", [False, True])
@pytest.mark.parametrize("kind", bags.LIVOX)
def test_equals_the_generic_decoder(kind: str, ros2: bool, order: str) -> None:
    assert kind in LIVOX_TYPES
    raw = _raw(bags.custom_message(bags.START_NS, _cloud(), ros2, kind), ros2, order)
    types = bags.store(ros2)
    oracle = types.deserialize_cdr(raw, kind) if ros2 else types.deserialize_ros1(raw, kind)
    expected = [point for point in oracle.points if point.tag & 0x30 in (0x00, 0x10)]
    assert 0 < len(expected) < len(oracle.points)
    cloud = decode_custom_msg(raw, ros2)
    assert cloud.stamp_ns == bags.START_NS
    np.testing.assert_array_equal(cloud.points, [[p.x, p.y, p.z] for p in expected])
    np.testing.assert_array_equal(cloud.time, [p.offset_time for p in expected])
    np.testing.assert_array_equal(cloud.ring, [p.line for p in expected])
    np.testing.assert_array_equal(cloud.intensity, [p.reflectivity for p in expected])
    assert cloud.time_field == "offset_time"


@pytest.mark.parametrize("frame", ["", "l", "li", "lid", "lida", "lidar_frame"])
def test_alignment_does_not_depend_on_the_frame_name(frame: str) -> None:
    message = bags.custom_message(bags.START_NS, _cloud(5), ros2=True)
    message.header.frame_id = frame
    message.points[0].tag = 0
    assert decode_custom_msg(_raw(message, True), True).points[0].tolist() == SEEN.points[0].tolist()


@pytest.mark.parametrize("ros2", [False, True])
def test_no_points_and_cut_messages(ros2: bool) -> None:
    empty = _raw(bags.custom_message(bags.START_NS, _cloud(0), ros2), ros2)
    assert decode_custom_msg(empty, ros2).points.shape == (0, 3)
    with pytest.raises(ValueError, match="no Livox points"):
        decode_custom_msg(empty[:-4], ros2)
    whole = _raw(bags.custom_message(bags.START_NS, _cloud(), ros2), ros2)
    with pytest.raises(ValueError, match="320 Livox points do not fit"):
        decode_custom_msg(whole[:-8], ros2)
    with pytest.raises(ValueError, match="no header"):
        decode_custom_msg(whole[:9], ros2)


def test_tags_keep_single_and_first_returns() -> None:
    tags = np.array([0x00, 0x10, 0x20, 0x30, 0x0F, 0x1F, 0xC0], np.uint8)
    assert keep_by_tag(tags).tolist() == [True, True, False, False, True, True, True]
