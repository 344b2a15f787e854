"""From a recorded scan to the padded arrays a step takes."""

from typing import Any

import numpy as np

from lio_jax.core.config import LidarConfig
from lio_jax.core.types import Scan
from lio_jax.data.sequence import LidarScan


def bucket_for(count: int, config: LidarConfig) -> int:
    """Return the smallest padded size that holds ``count`` points, or the largest there is."""
    return next((size for size in config.buckets if size >= count), config.buckets[-1])


def padded(scan: LidarScan, last_end_ns: int | None, config: LidarConfig, size: int | None = None) -> Scan:
    """Copy a scan into zero-padded arrays of its bucket's size.

    A scan larger than the largest bucket is thinned to it by an even stride. Points that are not finite are
    left for the step's range check to drop.

    Args:
        scan: as recorded.
        last_end_ns: end of the scan before, ns; None for the first.
        config: bucket sizes.
        size: padded size; None: the bucket that fits.
    """
    count = len(scan.points)
    size = size or bucket_for(count, config)
    keep = slice(None) if count <= size else np.linspace(0, count - 1, size).astype(np.intp)
    interval = 0 if last_end_ns is None else scan.end_ns - last_end_ns
    # host arrays: jit takes them as they are, one copy less than through jnp
    arrays: dict[str, Any] = {
        "points": _extended(scan.points[keep], size, np.float32),
        "time": _extended(scan.time[keep], size, np.float32),
        "ring": _extended(scan.ring[keep], size, np.int32),
        "intensity": _extended(scan.intensity[keep], size, np.float32),
        "mask": np.arange(size) < count,
        "duration": np.float32(scan.duration),
        "interval": np.float32(interval * 1e-9),
    }
    return Scan(**arrays)


def _extended(values: np.ndarray, size: int, dtype: type) -> np.ndarray:
    """Return ``values`` followed by zeros; only the padding is cleared, because that costs time."""
    extended = np.empty((size, *values.shape[1:]), dtype)
    extended[: len(values)] = values
    extended[len(values) :] = 0
    return extended
