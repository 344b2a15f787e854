"""Keep the keyframes for which a recipe has no more room, and hand them back near the vehicle.

A recipe holds a fixed number of keyframes on the device. The host keeps all that stay in the map for good.
After each scan the nearest of them that should be in the submap, and has lost its row, comes back. What comes
back depends on the outputs of the scans before alone, so that a resumed run repeats it.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.xla import programs
from lio_jax.mapping.keyframes import KeyframeCloud, Page
from lio_jax.recipes.recipe import Output, PagingRecipe


@runtime_checkable
class Pager(Protocol):
    """Hands parts of the map to a recipe during a run."""

    def take(self, output: Output) -> None:
        """Take the output of the next scan."""
        ...

    def paged(self, state: Any) -> Any:
        """Return a state with what comes after the scans so far, if anything; ``state`` is consumed."""
        ...


class _Stored(NamedTuple):
    """A keyframe on the host."""

    number: int
    wxyz_xyz: NDArray[np.float64]
    time: float
    corner: NDArray[np.float32]
    """(c, 3) m, lidar frame; the real ones only."""
    surface: NDArray[np.float32]
    """(s, 3) m, lidar frame."""


class KeyframePager:
    """The keyframes of a run, those without a row on the device included."""

    def __init__(self, recipe: PagingRecipe, params: Any) -> None:
        """Begin without keyframes.

        Args:
            recipe: of the run.
            params: of its steps.
        """
        self._params = params
        self._program = programs(type(recipe).with_page, recipe, donate=(1,))
        self._radius = float(params.submap.radius)
        self._stored: list[_Stored] = []
        self._positions = np.zeros((64, 3))
        self._rows = np.zeros(0, np.int32)
        self._here = np.zeros(3)
        self._room = (0, 0)

    def take(self, output: Output) -> None:
        """Take the output of the next scan."""
        table = output.keyframes
        assert table is not None
        pose = np.asarray(output.registration.T_world_lidar.wxyz_xyz, np.float64)
        self._here, self._rows = pose[4:], np.asarray(table.numbers)
        number = int(table.added)
        if number >= 0 and bool(table.sparse):
            self._store(number, pose, float(table.time), output)

    def paged(self, state: Any) -> Any:
        """Return a state with the keyframe that comes back after the scans so far, if any.

        Args:
            state: of the recipe; it is consumed.
        """
        wanted = self._wanted()
        return state if wanted is None else self._program(self._params, state, self._page(wanted))

    def moved(self, T_new_old: jaxlie.SE3, wxyz_xyz: NDArray[np.float64]) -> None:
        """Take over corrected poses.

        Args:
            T_new_old: moves the vehicle, m.
            wxyz_xyz: (n, 7) new T_world_lidar of all keyframes so far, by their running numbers.
        """
        self._here = np.asarray(T_new_old @ self._here)
        self._stored = [one._replace(wxyz_xyz=wxyz_xyz[one.number]) for one in self._stored]
        for index, one in enumerate(self._stored):
            self._positions[index] = one.wxyz_xyz[4:]

    def _store(self, number: int, pose: NDArray[np.float64], time: float, output: Output) -> None:
        count = len(self._stored)
        if count == len(self._positions):
            self._positions = np.concatenate([self._positions, np.zeros_like(self._positions)])
        self._positions[count] = pose[4:]
        mask, is_corner = np.asarray(output.points_mask), np.asarray(output.corners)
        self._room = int(is_corner.sum()), int((~is_corner).sum())
        # the difference of the origins is taken in double precision; the points count from a near origin
        from_lidar = np.asarray(output.points) + (np.asarray(output.origin) - pose[4:]).astype(np.float32)
        rotation = np.asarray(jaxlie.SO3(jnp.asarray(pose[:4])).as_matrix(), np.float32)
        points = from_lidar @ rotation
        corner, surface = (points[mask & kind] for kind in (is_corner, ~is_corner))
        self._stored.append(_Stored(number, pose, time, corner, surface))

    def _wanted(self) -> _Stored | None:
        """Return the nearest keyframe of the submap that has no row; None where each of them has one."""
        count = len(self._stored)
        away = np.linalg.norm(self._positions[:count] - self._here, axis=1)
        for index in np.flatnonzero(away <= self._radius)[np.argsort(away[away <= self._radius])].tolist():
            if self._stored[index].number not in self._rows:
                return self._stored[index]
        return None

    def _page(self, stored: _Stored) -> Page:
        corners, surfaces = self._room
        padded: list[jax.Array] = []
        for points, room in ((stored.corner, corners), (stored.surface, surfaces)):
            rows = np.zeros((room, 3), np.float32)
            rows[: len(points)] = points
            padded += [jnp.asarray(rows), jnp.arange(room) < len(points)]
        return Page(
            number=jnp.int32(stored.number),
            T_world_lidar=jaxlie.SE3(jnp.asarray(stored.wxyz_xyz)),
            time=jnp.asarray(stored.time),
            cloud=KeyframeCloud(*padded),
        )
