"""Point files of KITTI, binary float32 or text rows ``x y z intensity``; broken files are handled."""

from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.cloud_fields import valid_returns
from lio_jax.data.config import DataConfig
from lio_jax.data.reconstruct import (
    KITTI_START_AZIMUTH,
    azimuth_time,
    ring_from_azimuth_wraps,
    ring_from_elevation,
)
from lio_jax.data.sequence import LidarScan, check_still_there

BYTES_PER_POINT = 16
"""Size of one row x, y, z, intensity in float32."""
_HDL64_BEAMS = 64


def numbered_files(folder: Path, suffixes: Iterable[str]) -> dict[int, Path]:
    """Return the files whose names are numbers, by number, ascending."""
    wanted = set(suffixes)
    found = {int(path.stem): path for path in folder.iterdir() if path.suffix in wanted and _is_number(path)}
    return dict(sorted(found.items()))


def _is_number(path: Path) -> bool:
    # other alphabets' digits are decimal, too, and superscripts are digits that int() refuses
    return path.stem.isascii() and path.stem.isdecimal()


Runs = list[tuple[int, int]]
"""First and last number of each run of successive numbers: a wrong file name may leave a gap of billions."""


def missing_runs(files: dict[int, Path]) -> Runs:
    """Return the numbers that are absent between the first and the last."""
    return [(before + 1, after - 1) for before, after in pairwise(files) if after > before + 1]


def listed(numbers: list[int], digits: int) -> str:
    """Write scan numbers as runs: ``000003, 000007-000012``."""
    runs: Runs = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    return listed_runs(runs, digits)


def listed_runs(runs: Runs, digits: int) -> str:
    """Write runs of scan numbers: ``000003, 000007-000012``."""
    return ", ".join(
        f"{first:0{digits}d}" if first == last else f"{first:0{digits}d}-{last:0{digits}d}"
        for first, last in runs
    )


def read_returns(path: Path, warn: Callable[[str], None]) -> NDArray[np.float32] | None:
    """Read the valid returns of one point file: (n, 4) x, y, z in m and intensity.

    NaN, infinite and zero points are dropped. An empty file gives an empty scan, and a truncated file gives
    its whole points, both with a warning. A file that cannot be read at all gives None with a warning.

    Raises:
        LioJaxError: the whole folder is gone.
    """
    try:
        rows = _read_text(path, warn) if path.suffix == ".txt" else _read_binary(path, warn)
    except (OSError, ValueError) as error:
        check_still_there(path)
        warn(f"{path}: cannot be read ({error}), the scan was skipped.")
        return None
    valid = valid_returns(rows)
    return rows if valid.all() else rows[valid]


def check_sizes(paths: Iterable[Path], warn: Callable[[str], None]) -> None:
    """Warn of empty and truncated binary files as :func:`read_returns` will, without reading them."""
    for path in paths:
        if path.suffix == ".bin":
            _check_size(path, path.stat().st_size, warn)


def hdl64_scan(
    rows: NDArray[np.float32], stamp_ns: int, duration: float, vertical_correction_deg: float
) -> LidarScan:
    """Return the scan of KITTI's HDL-64E, which turns clockwise from straight behind.

    Args:
        rows: (n, 4) x, y, z in m and intensity, as :func:`read_returns` gives them.
        stamp_ns: time of the scan's start, ns.
        duration: time of the sweep, s; 0 where the points are motion compensated.
        vertical_correction_deg: see :func:`raise_elevation`.
    """
    points = np.ascontiguousarray(rows[:, :3])
    return LidarScan(
        stamp_ns=stamp_ns,
        points=raise_elevation(points, vertical_correction_deg),
        time=azimuth_time(points, duration, start_azimuth=KITTI_START_AZIMUTH),
        ring=_hdl64_ring(points),
        intensity=np.ascontiguousarray(rows[:, 3]),
        duration=duration,
    )


def _hdl64_ring(points: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return the beams by storage order, or by elevation where the order is not that of KITTI."""
    ring = ring_from_azimuth_wraps(points)
    if ring.size and ring[-1] >= _HDL64_BEAMS:
        return ring_from_elevation(points, _HDL64_BEAMS)
    return ring


def raise_elevation(points: NDArray[np.float32], angle_deg: float) -> NDArray[np.float32]:
    """Raise each point's elevation angle by ``angle_deg``: rotate it about cross(p, z).

    KITTI's intrinsic calibration is wrong by about 0.205 deg (IMLS-SLAM, Deschaud 2018). A point exactly
    above or below has no such axis and is not moved.

    Args:
        points: (n, 3) m, lidar frame.
        angle_deg: angle to add, deg; 0 returns the points as they are.
    """
    if angle_deg == 0.0 or len(points) == 0:
        return points
    cosine, sine = np.float32(np.cos(np.radians(angle_deg))), np.float32(np.sin(np.radians(angle_deg)))
    x, y, z = points.T
    horizontal = np.sqrt(x * x + y * y)
    has_axis = horizontal > 0
    scale = cosine - sine * z / np.where(has_axis, horizontal, np.float32(1.0))
    raised = np.stack([x * scale, y * scale, z * cosine + horizontal * sine], axis=1)
    if not has_axis.all():
        raised[~has_axis] = points[~has_axis]
    return raised


def elevation_note(config: DataConfig) -> list[str]:
    """Return a sentence on the correction of the elevation angles; none where there is no correction."""
    correction = config.vertical_correction_deg
    if not correction:
        return []
    return [f"elevation angles raised by {correction} deg (config.data.vertical_correction_deg)"]


def _read_binary(path: Path, warn: Callable[[str], None]) -> NDArray[np.float32]:
    size = path.stat().st_size
    _check_size(path, size, warn)
    return np.fromfile(path, np.float32, count=size // BYTES_PER_POINT * 4).reshape(-1, 4)


def _check_size(path: Path, size: int, warn: Callable[[str], None]) -> None:
    if size == 0:
        warn(f"{path}: the file is empty (0 bytes): an empty scan.")
    elif size % BYTES_PER_POINT:
        warn(
            f"{path}: truncated ({size} bytes, no multiple of {BYTES_PER_POINT}): its whole points are used."
        )


def _read_text(path: Path, warn: Callable[[str], None]) -> NDArray[np.float32]:
    lines = path.read_text(encoding="utf-8").split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        warn(f"{path}: the file is empty: an empty scan.")
        return np.zeros((0, 4), np.float32)
    if len(lines[-1].split()) != 4:
        lines.pop()
        warn(f"{path}: truncated (the last line is not 'x y z intensity'): its whole points are used.")
    rows = np.loadtxt(lines, np.float32, ndmin=2) if lines else np.zeros((0, 4), np.float32)
    if rows.shape[1] != 4:
        raise ValueError(f"{rows.shape[1]} numbers a line instead of 4")
    return rows
