"""Collect the map's points on disk while a run goes on, so that its memory does not grow."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.files import aside_of
from lio_jax.run.cloud_file import write_cloud

SPOOL_SUFFIX = ".spool"
_POINT_BYTES = 3 * np.dtype(np.float32).itemsize


class MapFile:
    """Points new to the map are appended to a spool file and become a PCD at the end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._spool_path = aside_of(path.with_suffix(SPOOL_SUFFIX))
        self._spool = self._spool_path.open("wb")

    def append(self, points: NDArray[np.float32]) -> None:
        """Add (n, 3) points, m in world."""
        self._spool.write(np.ascontiguousarray(points, np.float32).tobytes())

    def finish(self) -> NDArray[np.float32]:
        """Write the PCD (binary, x y z) and return its (n, 3) points."""
        self._spool.close()
        # an interrupted append may have left part of a point behind
        whole = self._spool_path.stat().st_size // _POINT_BYTES
        points = np.fromfile(self._spool_path, np.float32, 3 * whole).reshape(-1, 3)
        write_cloud(self._path, [points], len(points))
        return points

    def close(self) -> None:
        """Remove the spool file, whatever happened."""
        self._spool.close()
        self._spool_path.unlink(missing_ok=True)
