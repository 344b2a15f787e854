"""Keyframes of a run on disk, so that maps of any resolution can be made once it is over.

keyframes/NNNNNN.npz  points (n, 3) m, in the IMU frame at the stamp; corner (n,) where the recipe tells
                      corners from surfaces
keyframes/index.npz   stamps_ns (k,); T_world_imu (k, 4, 4), corrected; T_odom_imu (k, 4, 4), smooth
"""

import re
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path

FOLDER = "keyframes"
Part = Literal["whole", "corner", "surface"]

_INDEX = "index.npz"
_OURS = re.compile(r"(\d{6,}|index|\.(\d{6,}|index)\.[0-9a-f]{8})\.npz")
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


class KeyframeWriter:
    """Writes clouds while a run goes on, and where they belong at its end."""

    def __init__(self, run_folder: Path) -> None:
        self._folder = run_folder / FOLDER
        self._folder.mkdir(exist_ok=True)
        self._count = 0

    def append(self, points: NDArray[np.float32], corner: NDArray[np.bool_] | None = None) -> None:
        """Write the next keyframe's cloud.

        Args:
            points: (n, 3) m, in the IMU frame at the keyframe's stamp.
            corner: (n,) which of them are corners, where the recipe tells.
        """
        arrays: dict[str, Any] = {"points": np.asarray(points, np.float32)}
        if corner is not None:
            arrays["corner"] = np.asarray(corner, bool)
        with atomic_path(self._folder / _name(self._count)) as aside:
            np.savez(aside, **arrays)
        self._count += 1

    def finish(
        self,
        stamps_ns: NDArray[np.int64],
        T_world_imu: NDArray[np.float64],
        T_odom_imu: NDArray[np.float64],
    ) -> None:
        """Write the index; it may be written again with poses that are corrected further.

        Args:
            stamps_ns: (k,) of all keyframes appended.
            T_world_imu: (k, 4, 4) corrected poses.
            T_odom_imu: (k, 4, 4) poses of the smooth odometry.

        Raises:
            ValueError: there are more poses than clouds, or fewer.
        """
        shapes = (len(stamps_ns), np.shape(T_world_imu), np.shape(T_odom_imu))
        if shapes != (self._count, (self._count, 4, 4), (self._count, 4, 4)):
            raise ValueError(f"{self._count} keyframes were written; their index has {shapes}")
        with atomic_path(self._folder / _INDEX) as aside:
            np.savez(aside, stamps_ns=stamps_ns, T_world_imu=T_world_imu, T_odom_imu=T_odom_imu)


@dataclass(frozen=True, eq=False)
class StoredKeyframes:
    """The keyframes that a run left behind."""

    folder: Path
    stamps_ns: NDArray[np.int64]
    T_world_imu: NDArray[np.float64]
    """(k, 4, 4) corrected poses."""
    T_odom_imu: NDArray[np.float64]
    """(k, 4, 4) poses of the smooth odometry."""

    def points(self, number: int, part: Part = "whole") -> NDArray[np.float32]:
        """Return (n, 3) points of one keyframe, m, in its IMU frame.

        Raises:
            LioJaxError: the file is missing or damaged, or does not tell corners from surfaces.
        """
        path = self.folder / _name(number)
        arrays = _arrays(path)
        points, corner = arrays.get("points"), arrays.get("corner")
        if points is None or points.ndim != 2 or points.shape[1] != 3:
            raise LioJaxError(f"{path}: holds no points (n, 3); run again.")
        if part == "whole":
            return points.astype(np.float32, copy=False)
        if corner is None:
            raise LioJaxError(f"{path}: the recipe told no corners from surfaces; take the part 'whole'.")
        if corner.shape != (len(points),):
            raise LioJaxError(f"{path}: {len(points)} points, but {len(corner)} marks of corners; run again.")
        return points[corner == (part == "corner")].astype(np.float32, copy=False)

    def clouds(self, part: Part = "whole") -> Iterator[tuple[NDArray[np.float64], NDArray[np.float32]]]:
        """Yield T_world_imu (4, 4) and points (n, 3) of the keyframes whose pose is finite, one by one."""
        for number, T_world_imu in enumerate(self.T_world_imu):
            if np.isfinite(T_world_imu).all():
                yield T_world_imu, self.points(number, part)


def read_keyframes(run_folder: Path) -> StoredKeyframes:
    """Open the keyframes of a run; their clouds are read one by one.

    Raises:
        LioJaxError: there are none, or their index is missing or damaged.
    """
    folder = run_folder / FOLDER
    if not folder.is_dir():
        raise LioJaxError(f"{folder}: no such folder; the run kept no keyframes.")
    path = folder / _INDEX
    if not path.is_file():
        raise LioJaxError(f"{path}: missing, the run was ended before its poses were known; run again.")
    arrays = _arrays(path)
    names = ("stamps_ns", "T_world_imu", "T_odom_imu")
    if missing := [name for name in names if name not in arrays]:
        raise LioJaxError(f"{path}: lacks {', '.join(missing)}; run again.")
    stamps_ns, T_world_imu, T_odom_imu = (arrays[name] for name in names)
    if not (T_world_imu.shape == T_odom_imu.shape == (len(stamps_ns), 4, 4)):
        raise LioJaxError(f"{path}: its stamps and poses differ in number; run again.")
    return StoredKeyframes(folder, stamps_ns, T_world_imu, T_odom_imu)


def remove_keyframes(run_folder: Path, unfinished_only: bool = False) -> None:
    """Remove the keyframes of an earlier run, those half written too, and nothing else.

    Args:
        run_folder: of the run.
        unfinished_only: keep those with an index: their run came to its end.
    """
    folder = run_folder / FOLDER
    if not folder.is_dir() or folder.is_symlink() or (unfinished_only and (folder / _INDEX).exists()):
        return
    for entry in folder.iterdir():
        if _OURS.fullmatch(entry.name):
            entry.unlink()
    with suppress(OSError):  # something of another's is in it
        folder.rmdir()


def _name(number: int) -> str:
    return f"{number:06d}.npz"


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise LioJaxError(f"{path}: missing; run again.") from None
    except _UNREADABLE as error:
        raise LioJaxError(f"{path}: cannot be read ({error}); run again.") from None
