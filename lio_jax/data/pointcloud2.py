"""Points of PointCloud2 and Livox messages as arrays."""

import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.bag_files import Topic, cdr_aligned, read_header, why
from lio_jax.data.cloud_fields import RawCloud, assemble, choose_fields, cloud_of, keep_by_tag

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

LIVOX_TYPES = frozenset(
    f"{package}/msg/CustomMsg" for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)

_POINT_FIELDS = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_POINT_FORMATS = ("u4", "f4", "f4", "f4", "u1", "u1", "u1")
_POINT_BYTES = 19


def custom_msg_field_names() -> tuple[str, ...]:
    """Return name and type of each field of a CustomMsg's point, for example "x f4"."""
    return tuple(f"{name} {form}" for name, form in zip(_POINT_FIELDS, _POINT_FORMATS, strict=True))


def decode_custom_msg(raw: bytes, ros2: bool) -> RawCloud:
    """Decode a serialised CustomMsg of any Livox driver; times are uint32 ns from the header stamp.

    The bytes are read directly, because the generic decoder would make one Python object for each point.

    Raises:
        ValueError: the message is shorter than its header states.
    """
    header = read_header(raw, ros2)
    body = cdr_aligned(header.body, 8) if ros2 else header.body
    # uint64 timebase, uint32 point_num, uint8 lidar_id, uint8[3] rsvd, then the number of points and the
    # points.
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


TYPE = "sensor_msgs/msg/PointCloud2"

_SCALARS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class PointField(Protocol):
    """One entry of PointCloud2.fields."""

    name: str
    offset: int
    datatype: int
    count: int


def decode_pointcloud2(message: Any, *, time_field: str = "", where: str = "PointCloud2") -> RawCloud:
    """Decode a deserialised PointCloud2 message.

    Args:
        message: object with the attributes of sensor_msgs/PointCloud2, ``data`` as bytes or uint8 array.
        time_field: name of the per-point time; "" takes the first known name among the fields.
        where: the topic's name in errors.

    Raises:
        LioJaxError: x, y, z or the requested time field is not among the fields.
        ValueError: this message is damaged (shorter than its header states, or a field beyond the point).
    """
    stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    fields = {field.name: field for field in message.fields}
    chosen = choose_fields(fields, time_field, where, "choose another topic with config.data.lidar_topic")
    return cloud_of(stamp_ns, _grid(message, [fields[name] for name in chosen.read]), chosen)


def decode_cloud(reader: "AnyReader", topic: Topic, raw: bytes, time_field: str, where: str) -> RawCloud:
    """Decode one serialised message of ``topic``.

    Raises:
        LioJaxError: the topic's layout cannot be used.
        ValueError: this one message is damaged.
    """
    if topic.type in LIVOX_TYPES:
        return decode_custom_msg(raw, reader.is2)
    try:
        message: Any = reader.deserialize(raw, topic.type)
    # The generated decoders raise struct, index, unicode or their own errors on damaged bytes.
    except Exception as error:
        raise ValueError(f"the message cannot be decoded: {why(error)}") from error
    return decode_pointcloud2(message, time_field=time_field, where=where)


def field_names(message: Any) -> tuple[str, ...]:
    """Return name and type of each field of a PointCloud2, for example "x f4"."""
    return tuple(f"{field.name} {_SCALARS.get(field.datatype, '?')}" for field in message.fields)


def _grid(message: Any, fields: Sequence[PointField]) -> NDArray[Any]:
    """View the message's bytes as (height, width) structured points, without the padding between rows."""
    order = ">" if message.is_bigendian else "<"
    step, height, width = message.point_step, message.height, message.width
    formats = []
    for field in fields:
        if field.datatype not in _SCALARS:
            raise ValueError(f"field {field.name!r} has the unknown datatype {field.datatype}")
        formats.append(order + _SCALARS[field.datatype])
        if field.offset + np.dtype(formats[-1]).itemsize > step:
            raise ValueError(f"field {field.name!r} lies beyond the point's {step} bytes")
    dtype = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": formats,
            "offsets": [field.offset for field in fields],
            "itemsize": step,
        }
    )
    # Some drivers set row_step to 0 or to point_step; a row is never shorter than its points.
    row_step = max(message.row_step, width * step)
    needed = (height - 1) * row_step + width * step if height and width else 0
    if needed > len(message.data):
        raise ValueError(
            f"{height} x {width} points of {step} bytes do not fit into {len(message.data)} bytes"
        )
    if not needed:
        return np.empty((height, width), dtype)
    return np.ndarray((height, width), dtype, message.data, strides=(row_step, step))
