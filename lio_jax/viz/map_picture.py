"""A map from above as a small PNG, without a plotting library."""

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray

_INK = (108, 122, 136)
"""A grey that shows on white and on black; how full a pixel is decides how opaque it is."""
_FAINTEST = 60
_FULL_PERCENTILE = 98.0


def map_png(
    points: NDArray[np.floating], x: tuple[float, float], y: tuple[float, float], width: int
) -> bytes:
    """Return a picture with one scale in both directions; where nothing is it is transparent.

    The more points stand above each other, the darker: walls and trunks stand out from ground and ceiling.

    Args:
        points: (n, 3) m in world, z up.
        x: left and right edge, m.
        y: lower and upper edge, m.
        width: pixels; the height follows.
    """
    scale = width / (x[1] - x[0])
    height = max(1, round((y[1] - y[0]) * scale))
    column, row = np.floor((points[:, 0] - x[0]) * scale), np.floor((y[1] - points[:, 1]) * scale)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = (row[inside] * width + column[inside]).astype(np.int64)
    count = np.bincount(place, minlength=width * height)
    full = max(2.0, float(np.percentile(count[count > 0], _FULL_PERCENTILE))) if len(place) else 2.0
    share = np.clip(np.log1p(count) / np.log1p(full), 0.0, 1.0)
    opacity = np.where(count > 0, _FAINTEST + share * (255 - _FAINTEST), 0.0)
    return _ink_png(opacity.astype(np.uint8).reshape(height, width))


def data_uri(png: bytes) -> str:
    """Return a picture as an address that holds it."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _ink_png(opacity: NDArray[np.uint8]) -> bytes:
    """Encode one colour of varying opacity (PNG, W3C recommendation, third edition: palette with tRNS)."""
    height, width = opacity.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), opacity], axis=1)
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", bytes(_INK) * 256),
        (b"tRNS", bytes(range(256))),
        (b"IDAT", zlib.compress(rows.tobytes(), 6)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
