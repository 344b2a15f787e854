"""Points of PointCloud2 and Livox messages as arrays."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.bag_files import cdr_aligned, read_header


def valid_returns(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return whether x, y, z of each point (n, 3 or more columns) are finite and not all zero, (n,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared = points[:, 0] ** 2 + points[:, 1] ** 2 + points[:, 2] ** 2
    return np.isfinite(squared) & (squared > 0)


@dataclass(frozen=True)
class RawCloud:
    """The real returns of one message, with times in the sensor's own ticks."""

    stamp_ns: int
    """Header stamp, ns."""
    points: NDArray[np.float32]
    """Points, (n, 3) m, lidar frame, finite and not all zero."""
    intensity: NDArray[np.float32]
    """Intensity, (n,), in the sensor's scale; 0 where the message holds none."""
    ring: NDArray[np.int32] | None
    """Beam index, (n,); None where the message holds none."""
    ring_source: str
    """Name of the ring field; "rows" where the rows of an organised cloud replace it; "" without rings."""
    time: NDArray[Any] | None
    """Time of each point, (n,) ticks; None where the message holds none."""
    time_field: str
    """Name of the time field, "" where there is none."""
    time_range: tuple[float, float] | tuple[int, int] | None
    """Smallest and largest tick of the message, with firings without a return included."""
    dropped: int = 0
    """Number of recorded points that are not returns."""


def assemble(
    stamp_ns: int,
    xyz: NDArray[np.float32],
    intensity: NDArray[Any] | None,
    ring: NDArray[Any] | None,
    ring_source: str,
    time: NDArray[Any] | None,
    time_field: str,
    keep: NDArray[np.bool_] | None = None,
) -> RawCloud:
    """Drop points without a return (NaN, infinite, all zero, ``keep`` false, no finite time); pack the rest.

    Args:
        xyz: (3, n) m, one row for each coordinate.
        intensity, ring, time, keep: (n,) or None.
    """
    valid = valid_returns(xyz.T)
    if keep is not None:
        valid &= keep
    if time is not None and time.dtype.kind == "f":
        valid &= np.isfinite(time)
    if valid.all():
        chosen: Any = slice(None)
    else:
        chosen = np.flatnonzero(valid)
    points = np.ascontiguousarray(xyz[:, chosen].T)
    return RawCloud(
        stamp_ns,
        points,
        np.zeros(len(points), np.float32)
        if intensity is None
        else intensity[chosen].astype(np.float32, copy=False),
        None if ring is None else ring[chosen].astype(np.int32, copy=False),
        ring_source,
        None if time is None else time[chosen],
        time_field,
        None if time is None else _time_range(time, valid),
        len(valid) - len(points),
    )


def _time_range(time: NDArray[Any], valid: NDArray[np.bool_]) -> tuple[float, float] | tuple[int, int] | None:
    """Return the range of ticks; firings without a return count unless their time was zeroed, too."""
    counted = time[valid | (np.isfinite(time) & (time != 0))]
    if counted.size == 0:
        return None
    return counted.min().item(), counted.max().item()


LIVOX_TYPES = frozenset(
    f"{package}/msg/CustomMsg" for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)

_POINT_FIELDS = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_POINT_FORMATS = ("u4", "f4", "f4", "f4", "u1", "u1", "u1")
_POINT_BYTES = 19


def keep_by_tag(tag: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which points' return-number bits mark a single or a first return, as FAST-LIO2 keeps them, (n,).

    Source: FAST-LIO2's Livox preprocessing, ``(tag & 0x30) in {0x00, 0x10}``.
    """
    bits = tag & np.uint8(0x30)
    return (bits == 0x10) | (bits == 0x00)


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
        message: object with the attributes of sensor_msgs/PointCloud2, ``data`` as bytes or uint8 array.
        time_field: name of the per-point time; "" takes the first known name among the fields.
        where: the topic's name in errors.

    Raises:
        LioJaxError: x, y, z or the requested time field is not among the fields.
        ValueError: this message is damaged (shorter than its header states, or a field beyond the point).
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
    """Return name and type of each field of a PointCloud2, for example "x f4"."""
    return tuple(f"{field.name} {_SCALARS.get(field.datatype, '?')}" for field in message.fields)


def _first(candidates: Sequence[str], by_lower: dict[str, str]) -> str:
    return next((by_lower[name] for name in candidates if name in by_lower), "")


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


def _native(column: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(column, column.dtype.newbyteorder("=")).reshape(-1)


def _rows_as_ring(shape: tuple[int, ...]) -> NDArray[np.int32] | None:
    """Return the row numbers of an organised cloud as rings; the shorter side of the cloud is the beams."""
    height, width = shape
    if not 1 < min(height, width) <= _MOST_ROWS or height == width:
        return None
    rows, columns = np.indices(shape, np.int32, sparse=True)
    return np.broadcast_to(rows if height < width else columns, shape).reshape(-1)
