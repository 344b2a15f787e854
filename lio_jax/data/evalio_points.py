"""Scans of evalio, a harness of LiDAR-inertial systems, as arrays.

Its points are reached one Python object at a time, which takes longer than the odometry. They lie in one
vector of C++, so they are copied from there instead. Where that vector lies in a measurement is no promise of
evalio: the place is derived from measurements made here whose points are known, each process does so once,
and every measurement is checked for the same layout. Where a check fails, the points are read one by one.
"""

import ctypes
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.cloud_fields import valid_returns
from lio_jax.data.sequence import LidarScan

_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "range", "row", "col"],
        "formats": ["<f8", "<f8", "<f8", "<f8", "<i8", "<u4", "u1", "<u2"],
        "offsets": [0, 8, 16, 24, 32, 40, 44, 46],
        "itemsize": 48,
    }
)
"""A point in evalio's memory; t in ns."""
_HEADER = 2
"""Place of the word of a measurement that says how its value is held, in words of 8 bytes: behind the words
of every Python object."""
_SLACK = 0.02
"""Share of a sweep by which the last firing may come later than the rate says."""


class _Layout(NamedTuple):
    """Where a measurement keeps its points, in words of 8 bytes."""

    words: int
    """Size of a measurement."""
    header: int
    """The word that says how its value is held: here within the Python object itself."""
    first: int
    """Place of the address of the first point, followed by the address behind the last point."""


def points_of(measurement: Any) -> NDArray[Any]:
    """Return the points of a measurement as a structured array, copied.

    Args:
        measurement: an ``evalio.types.LidarMeasurement``.

    Returns:
        (n,) x, y, z in m, intensity, t in ns from the stamp, range, row and col, missing returns included.
    """
    layout = _layout()
    copied = None if layout is None else _copied(measurement, layout)
    return points_one_by_one(measurement) if copied is None else copied


def points_one_by_one(measurement: Any) -> NDArray[Any]:
    """Return what :func:`points_of` returns, by evalio's own accessors."""
    listed = measurement.points
    points = np.zeros(len(listed), _POINT)
    for name in ("x", "y", "z", "intensity", "range", "row", "col"):
        points[name] = [getattr(point, name) for point in listed]
    points["t"] = [point.t.nsec for point in listed]
    return points


def points_can_be_copied(measurement: Any) -> bool:
    """Return whether the points of a measurement can be copied, and are then those of evalio's accessors."""
    layout = _layout()
    copied = None if layout is None else _copied(measurement, layout)
    return copied is not None and _are_equal(copied, points_one_by_one(measurement))


def scan_of(measurement: Any, rate: float) -> LidarScan:
    """Return a measurement as a scan, without the firings that had no return.

    Args:
        measurement: an ``evalio.types.LidarMeasurement``.
        rate: scans per second. A scan lasts until the next one begins, or until its last firing if that is
            later; it has no duration if all its points have one time.
    """
    points = points_of(measurement)
    xyz = np.empty((len(points), 3), np.float32)
    for axis, name in enumerate("xyz"):
        xyz[:, axis] = points[name]
    since = points["t"]
    low, high = (int(since.min()), int(since.max())) if len(since) else (0, 0)
    # a clock that runs a little fast must not make every scan overlap the next one
    period_ns = 1e9 / rate
    duration_ns = 0 if low == high else high if high > (1 + _SLACK) * period_ns else round(period_ns)
    # column by column, as a sensor fires; along each row the order stays
    order = np.argsort(points["col"], kind="stable")
    kept = order[valid_returns(xyz)[order]]
    time = np.clip(since[kept] * 1e-9, 0.0, duration_ns * 1e-9).astype(np.float32)
    return LidarScan(
        stamp_ns=measurement.stamp.to_nsec(),
        points=xyz[kept],
        time=time,
        ring=points["row"][kept].astype(np.int32),
        intensity=points["intensity"][kept].astype(np.float32),
        duration=duration_ns * 1e-9,
        dropped=len(points) - len(kept),
    )


def _are_equal(one: NDArray[Any], other: NDArray[Any]) -> bool:
    # field by field: the bytes between them are not defined
    names = _POINT.names or ()
    return len(one) == len(other) and all(one[name].tobytes() == other[name].tobytes() for name in names)


def _copied(measurement: Any, layout: _Layout) -> NDArray[Any] | None:
    """Return the points from memory; None where the measurement has another layout."""
    words = _words(measurement, layout.words)
    if int(words[_HEADER]) != layout.header:
        return None
    first, behind, capacity = (int(word) for word in words[layout.first : layout.first + 3])
    if not first <= behind <= capacity or (behind - first) % _POINT.itemsize:
        return None
    if first == behind:
        return np.zeros(0, _POINT)
    points = np.zeros((behind - first) // _POINT.itemsize, _POINT)
    ctypes.memmove(points.ctypes.data, first, points.nbytes)
    return points


def _words(measurement: Any, count: int) -> NDArray[np.uint64]:
    # a copy of the Python object itself, which lives as long as it is referred to
    return np.frombuffer(ctypes.string_at(id(measurement), 8 * count), np.uint64)


@cache
def _layout() -> _Layout | None:
    """Return the layout that measurements of known points have; None where it is not as expected."""
    from evalio.types import LidarMeasurement

    size = LidarMeasurement.__basicsize__
    if size % 8 or not 8 * (_HEADER + 4) <= size <= 512:
        return None
    found: set[_Layout] = set()
    for count in (3, 5):
        measurement = _known(count)
        words = _words(measurement, size // 8)
        spans = [
            place
            for place in range(_HEADER + 1, len(words) - 2)
            if int(words[place + 1]) - int(words[place]) == count * _POINT.itemsize
            and words[place + 2] >= words[place + 1]
        ]
        if len(spans) != 1:
            return None
        layout = _Layout(size // 8, int(words[_HEADER]), spans[0])
        copied = _copied(measurement, layout)
        if copied is None or not _are_equal(copied, points_one_by_one(measurement)):
            return None
        found.add(layout)
    return found.pop() if len(found) == 1 else None


def _known(count: int) -> Any:
    """Return a measurement whose points differ in every field."""
    from evalio.types import Duration, LidarMeasurement, Point, Stamp

    points = [
        Point(
            x=1.5 + k,
            y=-2.25 - k,
            z=3.125 * (k + 1),
            intensity=7.0 + k,
            t=Duration.from_nsec(123_456_789 + k),
            range=0x11223344 + k,
            row=17 + k,
            col=0x5566 + k,
        )
        for k in range(count)
    ]
    return LidarMeasurement(Stamp.from_nsec(1_700_000_000_123_456_789), points)
