"""A decoded point-cloud message before its times are understood."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.returns import valid_returns


@dataclass(frozen=True)
class RawCloud:
    """The real returns of one message, times still in the sensor's own ticks."""

    stamp_ns: int
    """Header stamp, ns."""
    points: NDArray[np.float32]
    """(n, 3) m, finite and not all zero."""
    intensity: NDArray[np.float32]
    """(n,) 0 where the message holds none."""
    ring: NDArray[np.int32] | None
    """(n,) beam index."""
    ring_source: str
    """Name of the ring field; "rows" where an organised cloud's rows stand for it; "" where there is none."""
    time: NDArray[Any] | None
    """(n,) ticks."""
    time_field: str
    """Name of the time field, "" where there is none."""
    time_range: tuple[float, float] | tuple[int, int] | None
    """Least and greatest tick of the message, firings without a return included."""
    dropped: int = 0
    """Number of recorded points that are no returns."""


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
    """Drop what is no return (NaN, infinite, all zero, ``keep`` false, no finite time) and pack the rest.

    Args:
        xyz: (3, n) m, one row a coordinate.
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
    """Take firings without a return into account, unless their time was zeroed together with their point."""
    counted = time[valid | (np.isfinite(time) & (time != 0))]
    if counted.size == 0:
        return None
    return counted.min().item(), counted.max().item()
