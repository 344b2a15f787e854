"""Write point clouds (PCD, PLY) that need not fit in memory."""

from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import atomic_path

CLOUD_ENDINGS = (".pcd", ".ply")


def check_ending(path: Path) -> None:
    """Refuse a file whose ending tells no format.

    Raises:
        UsageError: it does not.
    """
    if path.suffix.lower() not in CLOUD_ENDINGS:
        raise UsageError(f"{path}: a map's name ends in {' or '.join(CLOUD_ENDINGS)}; choose one of them.")


def write_cloud(path: Path, parts: Iterable[NDArray[np.float32]], count: int) -> None:
    """Write points whole or not at all, in binary: PCD or, by the file's ending, PLY (little endian).

    Args:
        path: of the file.
        parts: arrays (n, 3) of points, m; taken one by one.
        count: how many points the parts have together, which both formats say in front.

    Raises:
        UsageError: another ending.
        ValueError: the parts have more points or fewer.
    """
    check_ending(path)
    with atomic_path(path) as aside, aside.open("wb") as file:
        file.write((_ply_header if path.suffix.lower() == ".ply" else _pcd_header)(count))
        written = sum(_append(file, part) for part in parts)
        if written != count:
            raise ValueError(f"{written} points came where {count} were announced")


def read_cloud(path: Path) -> NDArray[np.float32]:
    """Return the (n, 3) points of a PCD, m.

    Raises:
        LioJaxError: it cannot be read, or holds no x, y and z.
    """
    from pypcd4 import PointCloud

    try:
        return np.asarray(PointCloud.from_path(path).numpy(("x", "y", "z")), np.float32)
    except Exception as error:  # the library's own, numpy's and pydantic's
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise LioJaxError(f"{path}: cannot be read as a PCD ({reason}); write it again.") from None


def _append(file: BinaryIO, points: NDArray[np.float32]) -> int:
    file.write(np.ascontiguousarray(points, "<f4").tobytes())
    return len(points)


def _pcd_header(count: int) -> bytes:
    from pypcd4 import Encoding, MetaData

    xyz = MetaData(
        fields=("x", "y", "z"),
        size=(4, 4, 4),
        type=("F", "F", "F"),
        count=(1, 1, 1),
        points=count,
        width=count,
    )
    return xyz.compose_header(Encoding.BINARY).encode()


def _ply_header(count: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    return "\n".join([*lines, "end_header", ""]).encode()
