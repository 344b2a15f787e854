"""Colours of points by height, without a plotting library."""

import numpy as np
from numpy.typing import NDArray

# Blue to yellow in even steps of lightness, so that the order survives colour blindness and grey print.
_ANCHORS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64)


def _packed_table(size: int) -> NDArray[np.uint32]:
    where = np.linspace(0.0, len(_ANCHORS) - 1.0, size)
    channels = [np.interp(where, np.arange(len(_ANCHORS)), column).round() for column in _ANCHORS.T]
    red, green, blue = (channel.astype(np.uint32) for channel in channels)
    return (red << 24) | (green << 16) | (blue << 8) | np.uint32(255)


_TABLE = _packed_table(256)


def colour_by_height(height: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint32]:
    """Return (n,) packed 0xRRGGBBAA colours, from dark blue at ``low`` m to yellow at ``high`` m."""
    share = (height - low) / max(high - low, 1e-6)
    return _TABLE[np.clip(share * (len(_TABLE) - 1), 0, len(_TABLE) - 1).astype(np.int64)]
