"""Read single files of points: PCD, PLY, LAS, NumPy arrays, and KITTI's binary rows."""

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.las_file import read_las
from lio_jax.data.sequence import check_still_there
from lio_jax.data.velodyne_file import read_returns

_ROW = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")])
_COLUMNS = ("x", "y", "z", "intensity")

Warn = Callable[[str], None]


def read_cloud(path: Path, warn: Warn) -> NDArray[Any] | None:
    """Return the points of one file as a structured array, (n,), or (height, width) of an organised cloud.

    A truncated file gives its whole points, with a warning. A file that cannot be read at all gives None,
    with a warning.

    Args:
        path: path of the file; its suffix is in ``CLOUD_SUFFIXES``.
        warn: function that takes each sentence.

    Raises:
        LioJaxError: the whole folder is gone, or the library of the format is not installed.
    """
    try:
        return _READERS[path.suffix.lower()](path, warn)
    except LioJaxError:
        raise
    # pypcd4, laspy and the parsers of numpy raise exceptions of many kinds on damaged bytes
    except Exception as error:
        check_still_there(path)
        reason = " ".join(str(error).split()) or type(error).__name__
        warn(f"{path}: cannot be read ({reason}), it may be truncated: the scan was skipped.")
        return None


def _pcd(path: Path, warn: Warn) -> NDArray[Any]:
    from pypcd4 import PointCloud

    cloud = PointCloud.from_path(path)
    points: NDArray[Any] = np.atleast_1d(cloud.pc_data)
    stated = cloud.metadata
    if points.size < stated.points:
        warn(f"{path}: truncated ({points.size} of {stated.points} points): its whole points are used.")
    if stated.height > 1 and stated.height * stated.width == points.size:
        return points.reshape(stated.height, stated.width)
    return points


def _npy(path: Path, warn: Warn) -> NDArray[Any]:
    # opened here, because numpy leaves a damaged file open
    with path.open("rb") as file:
        array = np.load(file, allow_pickle=False)
    if not isinstance(array, np.ndarray):
        raise ValueError("it is an archive of arrays")
    if array.dtype.names is not None and array.ndim in (1, 2):
        return array
    if array.ndim != 2 or array.shape[1] not in (3, 4) or array.dtype.kind not in "fiu":
        raise ValueError(
            f"its array {array.shape} of {array.dtype} has neither 3 columns (x y z) nor 4 (x y z intensity) "
            "nor named fields"
        )
    points = np.empty(len(array), [(name, array.dtype) for name in _COLUMNS[: array.shape[1]]])
    for column, name in zip(array.T, _COLUMNS, strict=False):
        points[name] = column
    return points


def _bin(path: Path, warn: Warn) -> NDArray[Any] | None:
    rows = read_returns(path, warn)
    return None if rows is None else np.ascontiguousarray(rows).view(_ROW)[:, 0]


_SCALARS = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_LINES = 1000
_CLOUDCOMPARE = "scalar_"
"""CloudCompare puts this before the names of all fields that are not coordinates."""


def _ply(path: Path, warn: Warn) -> NDArray[Any]:
    """Return the vertices of a PLY file, (n,): text, or binary in either byte order.

    Format: Turk, "The PLY Polygon File Format", 1994.
    """
    with path.open("rb") as file:
        order, count, dtype = _header(file)
        # a damaged header may state any number
        most = min(count, path.stat().st_size)
        points: NDArray[Any]
        if order:
            points = np.frombuffer(file.read(most * dtype.itemsize), np.uint8)
            points = points[: len(points) // dtype.itemsize * dtype.itemsize].view(dtype)
        else:
            points = _text_points(file, most, dtype)
    if len(points) < count:
        warn(f"{path}: truncated ({len(points)} of {count} points): its whole points are used.")
    return points


def _text_points(file: BinaryIO, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    lines = [line.decode("ascii") for line in islice(file, count)]
    # the last line of a truncated file may be cut
    if lines and len(lines[-1].split()) != len(dtype.names or ()):
        lines.pop()
    return np.loadtxt(lines, dtype, ndmin=1) if lines else np.empty(0, dtype)


def _header(file: BinaryIO) -> tuple[str, int, np.dtype[Any]]:
    """Return the byte order ("" for text), the number of vertices, and the type of a vertex."""
    lines = _header_lines(file)
    if next(lines, []) != ["ply"]:
        raise ValueError("it does not begin with 'ply'")
    order, count = None, None
    fields: list[tuple[str, str]] = []
    elements = 0
    for words in lines:
        match words:
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, number]:
                elements += 1
                if elements == 1 and name == "vertex" and number.isdecimal():
                    count = int(number)
            case ["property", kind, name] if elements == 1 and kind in _SCALARS:
                fields.append((name.removeprefix(_CLOUDCOMPARE), _SCALARS[kind]))
            case ["property", *_] if elements == 1:
                raise ValueError(f"its points have the property '{' '.join(words[1:])}', which is no number")
    if order is None or count is None or not fields:
        raise ValueError("its header lacks a known format, or its first element is no vertex")
    return order, count, np.dtype([(name, order + kind) for name, kind in fields])


def _header_lines(file: BinaryIO) -> Iterator[list[str]]:
    for line in islice(file, _MOST_LINES):
        words = line.decode("ascii", "replace").split()
        if words == ["end_header"]:
            return
        yield words
    raise ValueError("its header has no end")


_READERS: dict[str, Callable[[Path, Warn], NDArray[Any] | None]] = {
    ".pcd": _pcd,
    ".ply": _ply,
    ".npy": _npy,
    ".bin": _bin,
    ".las": read_las,
}
CLOUD_SUFFIXES = tuple(_READERS)
"""Endings of the files that are read as clouds."""
