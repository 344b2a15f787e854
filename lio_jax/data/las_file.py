"""Read LAS files, uncompressed, by the library laspy (extra ``las``).

Format: ASPRS, "LAS Specification 1.4 - R15", 2019.
"""

import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError

COMPRESSED_SUFFIX = ".laz"
"""Ending of compressed LAS files, which are not read: their library ends the process on a damaged one."""
DECOMPRESS = "decompress them to .las (for example with laszip, PDAL or CloudCompare)"

_SIZES = struct.Struct("<94xHII")
"""Size of the header, offset of the points, and number of variable length records, at byte 94."""
_SHORTEST_RECORD = 54
"""Size of a variable length record without data, bytes."""
_LASZIP = "laszip encoded"
_STANDARD = ("intensity", "gps_time")
"""Dimensions that are read of each point beside its coordinates, where the point format has them."""

# without a handler Python prints what laspy logs about damaged headers
logging.getLogger("laspy").addHandler(logging.NullHandler())


def read_las(path: Path, warn: Callable[[str], None]) -> NDArray[Any] | None:
    """Return the points of a LAS file as a structured array, (n,).

    Its fields are x, y and z in m (float64), intensity, gps_time in s where the point format has it, and the
    extra dimensions that hold one number a point, scaled as the file states it. A truncated file gives its
    whole points, with a warning. A file with compressed points gives None, with a warning.

    Args:
        path: path of the file.
        warn: function that takes each sentence.

    Raises:
        LioJaxError: laspy is not installed.
        ValueError: the header cannot be right. Laspy raises exceptions of other kinds on damaged headers.
    """
    try:
        import laspy
    except ImportError:
        raise LioJaxError(
            f"{path}: LAS files are read by laspy, which is not installed; install it with "
            "pip install 'lio-jax[las]'."
        ) from None
    with path.open("rb") as file:
        size = path.stat().st_size
        _check_sizes(file, size)
        reader = laspy.open(file, closefd=False, read_evlrs=False)
        header = reader.header
        if header.are_points_compressed or header.vlrs.get_by_id(_LASZIP):
            warn(f"{path}: its points are compressed (LAZ): {DECOMPRESS}; the scan was skipped.")
            return None
        # a damaged header may state any number of points
        whole = (size - header.offset_to_point_data) // header.point_format.size
        records = reader.read_points(min(header.point_count, whole)).array
    if len(records) < header.point_count:
        warn(f"{path}: truncated ({len(records)} of {header.point_count} points): its whole points are used.")
    return _points(records, header)


def _check_sizes(file: BinaryIO, size: int) -> None:
    """Raise ValueError where laspy would take minutes or much memory; then go back to the file's start."""
    head = file.read(_SIZES.size)
    file.seek(0)
    if len(head) < _SIZES.size or not head.startswith(b"LASF"):
        raise ValueError("it does not begin with the header of a LAS file")
    header_size, offset, records = _SIZES.unpack(head)
    if offset > size:
        raise ValueError(f"its points would begin at byte {offset} of {size}")
    if records * _SHORTEST_RECORD > max(offset - header_size, 0):
        raise ValueError(f"its header has no room for {records} variable length records")


def _points(records: NDArray[Any], header: Any) -> NDArray[Any]:
    columns = {
        axis: _scaled(records[axis.upper()], scale, offset)
        for axis, scale, offset in zip("xyz", header.scales, header.offsets, strict=True)
    }
    for dimension in header.point_format.dimensions:
        name = dimension.name
        if name in _STANDARD or (not dimension.is_standard and dimension.num_elements == 1):
            values = records[name]
            if dimension.is_scaled:
                values = _scaled(values, dimension.scales, dimension.offsets)
            columns.setdefault(name, values)
    points = np.empty(len(records), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        points[name] = values
    return points


def _scaled(
    values: NDArray[Any], scale: float | NDArray[np.float64], offset: float | NDArray[np.float64]
) -> NDArray[np.float64]:
    # factors of a damaged header may be infinite or NaN; the points are dropped afterwards
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(values * scale + offset, np.float64)
