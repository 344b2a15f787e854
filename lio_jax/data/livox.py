"""Decode Livox CustomMsg, and tell noise from returns by Livox point tags."""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.raw_cloud import RawCloud, assemble
from lio_jax.data.ros_header import cdr_aligned, read_header

TYPES = frozenset(
    f"{package}/msg/CustomMsg" for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)

_POINT_FIELDS = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_POINT_FORMATS = ("u4", "f4", "f4", "f4", "u1", "u1", "u1")
_POINT_BYTES = 19


def keep_by_tag(tag: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Keep the points whose return-number bits mark a single or a first return, as FAST-LIO2 does.

    Source: FAST-LIO2's Livox preprocessing, ``(tag & 0x30) in {0x00, 0x10}``.
    """
    bits = tag & np.uint8(0x30)
    return (bits == 0x10) | (bits == 0x00)


def field_names() -> tuple[str, ...]:
    """Return name and type of a CustomMsg's point, such as "x f4"."""
    return tuple(f"{name} {form}" for name, form in zip(_POINT_FIELDS, _POINT_FORMATS, strict=True))


def decode_custom_msg(raw: bytes, ros2: bool) -> RawCloud:
    """Decode a serialised CustomMsg of any Livox driver; times are uint32 ns from the header stamp.

    The bytes are read directly: the generic decoder would make one Python object a point.

    Raises:
        ValueError: the message is shorter than it says.
    """
    header = read_header(raw, ros2)
    body = cdr_aligned(header.body, 8) if ros2 else header.body
    # uint64 timebase, uint32 point_num, uint8 lidar_id, uint8[3] rsvd, then the points behind their number.
    try:
        (count,) = struct.unpack_from(f"{header.order}I", raw, body + 16)
    except struct.error:
        raise ValueError(f"a message of {len(raw)} bytes holds no Livox points") from None
    stride = _POINT_BYTES + 1 if ros2 else _POINT_BYTES
    if count and body + 20 + (count - 1) * stride + _POINT_BYTES > len(raw):
        raise ValueError(f"{count} Livox points do not fit into {len(raw)} bytes")
    dtype = np.dtype(
        [(name, header.order + form) for name, form in zip(_POINT_FIELDS, _POINT_FORMATS, strict=True)]
    )
    points: NDArray[Any] = np.empty(0, dtype)
    if count:
        points = np.ndarray((count,), dtype, raw, offset=body + 20, strides=(stride,))
    xyz = np.empty((3, count), np.float32)
    for row, axis in zip(xyz, "xyz", strict=True):
        row[:] = points[axis]
    return assemble(
        header.stamp_ns,
        xyz,
        points["reflectivity"],
        points["line"],
        "line",
        points["offset_time"].astype(np.uint32),
        "offset_time",
        keep_by_tag(points["tag"]),
    )
