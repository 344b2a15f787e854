"""Points of any source as arrays: which of its fields are coordinates, time, ring and intensity."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError


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
    """Drop points without a return, and pack the rest.

    A point counts as without a return if a coordinate is NaN or infinite, if all are zero, if its time or its
    ring is no number, or where ``keep`` is false.

    Args:
        xyz: (3, n) m, one row for each coordinate.
        intensity, ring, time, keep: (n,) or None.
    """
    valid = valid_returns(xyz.T)
    if keep is not None:
        valid &= keep
    if time is not None and time.dtype.kind == "f":
        valid &= np.isfinite(time)
    if ring is not None and ring.dtype.kind == "f":
        valid &= np.abs(ring) <= _HIGHEST_RING
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


def keep_by_tag(tag: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which points' return-number bits mark a single or a first return, as FAST-LIO2 keeps them, (n,).

    Source: FAST-LIO2's Livox preprocessing, ``(tag & 0x30) in {0x00, 0x10}``.
    """
    bits = tag & np.uint8(0x30)
    return (bits == 0x10) | (bits == 0x00)


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
    "timestamps",
    "stamps",
    "gps_time",
    "gpstime",
)
_RING = ("ring", "line", "channel", "laser_id", "laserid", "laser", "beam", "ring_id")
_INTENSITY = ("intensity", "intensities", "reflectivity", "signal", "reflectance", "i")
_MOST_ROWS = 256
_HIGHEST_RING = 2**31 - 256
"""Largest ring that a float32 states and an int32 holds."""


@dataclass(frozen=True)
class CloudFields:
    """Names of the fields that are read of each point; "" where there is none."""

    x: str
    y: str
    z: str
    time: str
    ring: str
    intensity: str
    tag: str
    """Livox's tag with the bits of the return's number."""

    @property
    def read(self) -> list[str]:
        """Return each name once."""
        wanted = (self.x, self.y, self.z, self.time, self.ring, self.intensity, self.tag)
        return [name for name in dict.fromkeys(wanted) if name]


def choose_fields(names: Iterable[str], time_field: str, where: str, remedy: str) -> CloudFields:
    """Recognise by their names the fields of the drivers of Ouster, Velodyne, Hesai, RoboSense and Livox.

    Args:
        names: names of all fields; upper and lower case count as equal.
        time_field: name of the per-point time; "" takes the first known name.
        where: topic or file, with which an error begins.
        remedy: what to do if x, y or z is missing, the end of a sentence without its point.

    Raises:
        LioJaxError: x, y, z or the requested time field is not among the fields.
    """
    names = list(names)
    by_lower = {name.lower(): name for name in reversed(names)}
    missing = [axis for axis in "xyz" if axis not in by_lower]
    if missing:
        raise LioJaxError(
            f"{where}: the point cloud has no field {' or '.join(map(repr, missing))}; "
            f"its fields are {', '.join(names) or 'none'}; {remedy}."
        )
    if time_field and time_field not in names:
        raise LioJaxError(
            f"{where}: config.data.time_field={time_field!r} is not a field of the point cloud; "
            f"its fields are {', '.join(names)}."
        )
    return CloudFields(
        x=by_lower["x"],
        y=by_lower["y"],
        z=by_lower["z"],
        time=time_field or _first(_TIME, by_lower),
        ring=_first(_RING, by_lower),
        intensity=_first(_INTENSITY, by_lower),
        tag=by_lower.get("tag", "") if "line" in by_lower else "",
    )


def cloud_of(stamp_ns: int, grid: NDArray[Any], fields: CloudFields) -> RawCloud:
    """Return the real returns of a cloud.

    Args:
        stamp_ns: stamp of the cloud, ns.
        grid: structured array of the points, (height, width) or (n,), in any byte order.
        fields: which of its fields are read.
    """

    def column(name: str) -> NDArray[Any] | None:
        return _native(grid[name]) if name else None

    xyz = np.empty((3, grid.size), np.float32)
    for row, name in zip(xyz, (fields.x, fields.y, fields.z), strict=True):
        with np.errstate(over="ignore", invalid="ignore"):
            row.reshape(grid.shape)[...] = grid[name]
    ring, ring_source = column(fields.ring), fields.ring
    if ring is None and (rows := _rows_as_ring(grid.shape)) is not None:
        ring, ring_source = rows, "rows"
    tag = column(fields.tag)
    return assemble(
        stamp_ns,
        xyz,
        column(fields.intensity),
        ring,
        ring_source,
        column(fields.time),
        fields.time,
        None if tag is None else keep_by_tag(tag.astype(np.uint8, copy=False)),
    )


def _first(candidates: Iterable[str], by_lower: dict[str, str]) -> str:
    return next((by_lower[name] for name in candidates if name in by_lower), "")


def _native(column: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(column, column.dtype.newbyteorder("=")).reshape(-1)


def _rows_as_ring(shape: tuple[int, ...]) -> NDArray[np.int32] | None:
    """Return the row numbers of an organised cloud as rings; the shorter side of the cloud is the beams."""
    if len(shape) != 2:
        return None
    height, width = shape
    if not 1 < min(height, width) <= _MOST_ROWS or height == width:
        return None
    rows, columns = np.indices(shape, np.int32, sparse=True)
    return np.broadcast_to(rows if height < width else columns, shape).reshape(-1)
