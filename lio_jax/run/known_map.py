"""The map of an earlier run, handed to a recipe near the vehicle, scan by scan."""

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.types import state_dtype
from lio_jax.core.xla import programs
from lio_jax.data.cloud_files import read_cloud
from lio_jax.data.trajectory import read_tum
from lio_jax.recipes.recipe import LocalisingRecipe, Output
from lio_jax.run.map_file import CLOUD_ENDINGS, FARTHEST

_TILE = 20.0
"""Edge of the tiles in which a map is handed over, m."""
_SHARE_OF_REACH = 0.75
"""Tiles nearer than this share of the reach of the recipe's map are in it: what lies beyond the reach may be
forgotten."""
_ROWS = 16384
"""Number of points handed over at a time."""
_MOVED = 5.0
"""Distance after which the tiles around the vehicle are chosen anew, m."""

Chunk = tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float64]]
"""Points from an origin, which of them are real, and the origin."""


class KnownMap:
    """The points of a map, in tiles."""

    def __init__(self, points: NDArray[np.float64]) -> None:
        """Sort the points into tiles.

        Args:
            points: (n, 3) m, in the map's world.
        """
        tile = np.floor(points[:, :2] / _TILE).astype(np.int64)
        order = np.lexsort((tile[:, 1], tile[:, 0]))
        tile, self.points = tile[order], points[order]
        """(n, 3) m, in the map's world, tile by tile."""
        self._tiles, begins = np.unique(tile, axis=0, return_index=True)
        self._begins = np.append(begins, len(points))
        self._centres = (self._tiles + 0.5) * _TILE

    @staticmethod
    def read(path: Path | str) -> "KnownMap":
        """Return the map that an earlier run has written.

        Args:
            path: .pcd or .ply, or the folder of a run, whose ``map.pcd`` is read.

        Raises:
            LioJaxError: there is no such file, it cannot be read, or it holds no points.
        """
        path = Path(path)
        file = path / "map.pcd" if path.is_dir() else path
        if not file.is_file() or file.suffix.lower() not in CLOUD_ENDINGS:
            raise LioJaxError(
                f"{file}: no such map; give the folder of a run with map.pcd, or a .pcd or .ply file."
            )
        faults: list[str] = []
        cloud = read_cloud(file, faults.append)
        if cloud is None or faults:
            raise LioJaxError(f"{file}: damaged or cut short; write the map again.")
        if not {"x", "y", "z"} <= set(cloud.dtype.names or ()):
            raise LioJaxError(f"{file}: has no fields x, y and z; write the map again.")
        points = np.stack([cloud[axis].astype(np.float64).ravel() for axis in "xyz"], axis=-1)
        # a comparison with NaN is False
        points = points[(np.abs(points) < FARTHEST).all(axis=1)]
        if not len(points):
            raise LioJaxError(f"{file}: holds no possible points; write the map again.")
        return KnownMap(points)

    def around(self, position: NDArray[np.float64], reach: float) -> NDArray[np.float32]:
        """Return the points with |x| and |y| below ``reach`` from a position, (n, 3) m from there."""
        near = np.abs(self._centres - position[:2]).max(axis=1, initial=0) < reach + _TILE / 2
        found = np.concatenate([np.zeros((0, 3)), *(self.tile(one) for one in np.flatnonzero(near).tolist())])
        found = found - position
        return found[np.abs(found[:, :2]).max(axis=1, initial=0) < reach].astype(np.float32)

    def tile(self, number: int) -> NDArray[np.float64]:
        """Return the points of a tile, (n, 3) m."""
        return self.points[self._begins[number] : self._begins[number + 1]]

    def distances(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the horizontal distance of each tile's centre from a position, m."""
        return np.asarray(np.linalg.norm(self._centres - position[:2], axis=1))


class MapPager:
    """Hands the tiles near the vehicle to the recipe, some points after each scan.

    What is handed over depends on the outputs of the scans before alone, so that a resumed run repeats it.
    """

    def __init__(
        self, known: KnownMap, recipe: LocalisingRecipe, params: Any, start: NDArray[np.float64]
    ) -> None:
        """Choose the tiles near the start.

        Args:
            known: the map.
            recipe: of the run.
            params: of its steps.
            start: (3,) position of the first scan, m.
        """
        self._known, self._params = known, params
        self._program = programs(type(recipe).with_map_points, recipe, donate=(1,))
        self._near = _SHARE_OF_REACH * float(params.map.reach)
        self._held: set[int] = set()
        self._chosen_at = start
        self._first = list(self._chosen())
        self._waiting: deque[Chunk] = deque()
        self._next: Chunk | None = None

    def take(self, output: Output) -> None:
        """Take the output of the next scan."""
        self.moved_to(np.asarray(output.registration.T_world_lidar.wxyz_xyz, np.float64)[4:])

    def moved_to(self, here: NDArray[np.float64]) -> None:
        """Choose what is handed over next to a vehicle at a position, (3,) m; NaN: where it was."""
        if np.isfinite(here).all() and np.linalg.norm(here - self._chosen_at) > _MOVED:
            self._chosen_at = here
            # a part of the map that was left may have been forgotten
            away = self._known.distances(here)
            self._held = {tile for tile in self._held if away[tile] < self._near + 2 * _TILE}
            self._waiting.extend(self._chosen())
        self._next = self._waiting.popleft() if self._waiting else None

    def paged(self, state: Any) -> Any:
        """Return a state with the points that come after the scans so far, if any; ``state`` is consumed."""
        chunk, self._next = self._next, None
        return state if chunk is None else self._program(self._params, state, *chunk)

    def filled(self, state: Any) -> Any:
        """Return a first state with all tiles near the start; ``state`` is consumed."""
        for chunk in self._first:
            state = self._program(self._params, state, *chunk)
        return state

    def _chosen(self) -> Iterator[Chunk]:
        """Yield the points of the tiles near the vehicle that were not handed over, the nearest first."""
        away, origin = self._known.distances(self._chosen_at), self._chosen_at
        order = np.argsort(away, kind="stable")
        fresh = [one for one in order[away[order] < self._near].tolist() if one not in self._held]
        self._held.update(fresh)
        points = np.concatenate([np.zeros((0, 3)), *(self._known.tile(one) for one in fresh)]) - origin
        for begin in range(0, len(points), _ROWS):
            some = points[begin : begin + _ROWS]
            rows = np.zeros((_ROWS, 3), np.float32)
            rows[: len(some)] = some
            yield rows, np.arange(_ROWS) < len(some), origin.astype(state_dtype())


def driven_path(path: Path) -> NDArray[np.float64]:
    """Return the positions of the run that made a map, (k, 3) m.

    Raises:
        LioJaxError: the path is not the folder of a run.
    """
    file = path / "trajectory.tum"
    if not file.is_file():
        raise LioJaxError(
            f"{file}: no such file; config.known_map.search searches along the run in the folder "
            "config.known_map.path."
        )
    return np.asarray(read_tum(file).poses[:, :3, 3])
