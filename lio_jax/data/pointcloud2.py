"""Decode sensor_msgs/PointCloud2 with any field layout."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.livox import keep_by_tag
from lio_jax.data.raw_cloud import RawCloud, assemble

TYPE = "sensor_msgs/msg/PointCloud2"

_TIME = (
    "t",
    "time",
    "timestamp",
    "time_stamp",
    "offset_time",
    "timeoffset",
    "time_offset",
    "point_time",
    "ts",
    "stamp",
)
_RING = ("ring", "line", "channel", "laser_id", "laserid", "laser", "beam", "ring_id")
_INTENSITY = ("intensity", "intensities", "reflectivity", "signal", "reflectance", "i")
_SCALARS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_ROWS = 256


class PointField(Protocol):
    """One entry of PointCloud2.fields."""

    name: str
    offset: int
    datatype: int
    count: int


def decode_pointcloud2(message: Any, *, time_field: str = "", where: str = "PointCloud2") -> RawCloud:
    """Decode a deserialised PointCloud2 message.

    Args:
        message: with the attributes of sensor_msgs/PointCloud2, ``data`` as bytes or uint8 array.
        time_field: name of the per-point time; "" takes the first known name that is there.
        where: how errors name the topic.

    Raises:
        LioJaxError: x, y, z or the requested time field is not among the fields.
        ValueError: this one message is damaged (shorter than it says, or a field beyond the point).
    """
    stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    fields = {field.name: field for field in message.fields}
    by_lower = {name.lower(): name for name in reversed(fields)}
    missing = [axis for axis in "xyz" if axis not in by_lower]
    if missing:
        raise LioJaxError(
            f"{where}: the point cloud has no field {' or '.join(map(repr, missing))}; "
            f"its fields are {', '.join(fields) or 'none'}; "
            "choose another topic with config.data.lidar_topic."
        )
    if time_field and time_field not in fields:
        raise LioJaxError(
            f"{where}: config.data.time_field={time_field!r} is not a field of the point cloud; "
            f"its fields are {', '.join(fields)}."
        )
    time_name = time_field or _first(_TIME, by_lower)
    ring_name, intensity_name = _first(_RING, by_lower), _first(_INTENSITY, by_lower)
    tag_name = by_lower.get("tag", "") if "line" in by_lower else ""
    wanted = [by_lower[axis] for axis in "xyz"] + [time_name, ring_name, intensity_name, tag_name]
    grid = _grid(message, [fields[name] for name in dict.fromkeys(wanted) if name])

    def column(name: str) -> NDArray[Any] | None:
        return _native(grid[name]) if name else None

    xyz = np.empty((3, grid.size), np.float32)
    for row, axis in zip(xyz, "xyz", strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            row.reshape(grid.shape)[...] = grid[by_lower[axis]]
    ring, ring_source = column(ring_name), ring_name
    if ring is None and (rows := _rows_as_ring(grid.shape)) is not None:
        ring, ring_source = rows, "rows"
    tag = column(tag_name)
    return assemble(
        stamp_ns,
        xyz,
        column(intensity_name),
        ring,
        ring_source,
        column(time_name),
        time_name,
        None if tag is None else keep_by_tag(tag.astype(np.uint8, copy=False)),
    )


def field_names(message: Any) -> tuple[str, ...]:
    """Return name and type of a PointCloud2's fields, such as "x f4"."""
    return tuple(f"{field.name} {_SCALARS.get(field.datatype, '?')}" for field in message.fields)


def _first(candidates: Sequence[str], by_lower: dict[str, str]) -> str:
    return next((by_lower[name] for name in candidates if name in by_lower), "")


def _grid(message: Any, fields: Sequence[PointField]) -> NDArray[Any]:
    """View the message's bytes as (height, width) structured points, padding between rows left out."""
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
    # Some drivers leave row_step at 0 or at point_step; a row can never be shorter than its points.
    row_step = max(message.row_step, width * step)
    needed = (height - 1) * row_step + width * step if height and width else 0
    if needed > len(message.data):
        raise ValueError(
            f"{height} x {width} points of {step} bytes do not fit into {len(message.data)} bytes"
        )
    if not needed:
        return np.empty((height, width), dtype)
    return np.ndarray((height, width), dtype, message.data, strides=(row_step, step))


def _native(column: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(column, column.dtype.newbyteorder("=")).reshape(-1)


def _rows_as_ring(shape: tuple[int, ...]) -> NDArray[np.int32] | None:
    """Number the beams of an organised cloud, whose shorter side is the beams."""
    height, width = shape
    if not 1 < min(height, width) <= _MOST_ROWS or height == width:
        return None
    rows, columns = np.indices(shape, np.int32, sparse=True)
    return np.broadcast_to(rows if height < width else columns, shape).reshape(-1)
