"""Begin a run in the map of an earlier one: find the pose of the first scan there."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.types import ImuBatch, state_dtype
from lio_jax.core.xla import programs
from lio_jax.data.sequence import ImuData, Sequence
from lio_jax.loops.overlap import Candidate
from lio_jax.loops.place_in_map import places_along, places_near
from lio_jax.pose_graph.graph import heading_of
from lio_jax.recipes.recipe import LocalisingRecipe
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.known_map import KnownMap, MapPager, driven_path
from lio_jax.run.scan_inputs import InputsInTurn, ScanInput, feed_of
from lio_jax.run.track import pose_matrix
from lio_jax.settings.settings import Settings, recipe_of

_SCANS_TRIED = 50
"""Number of first scans among which one must have enough points."""


@dataclass(frozen=True, eq=False)
class FoundStart:
    """The pose of a first scan in a known map."""

    T_world_imu: NDArray[np.float64]
    """(4, 4) m, in the map's world, at the scan's end."""
    overlap: float
    """Share of the scan's points on upright objects that agree with the map, 0 to 1."""
    fitness: float
    """Mean squared distance to the map of the points that have a counterpart there, m^2."""

    def __str__(self) -> str:
        position = ", ".join(f"{number:.2f}" for number in self.T_world_imu[:3, 3])
        return (
            f"the first scan lies in the known map at [{position}] m, heading "
            f"{heading_of(self.T_world_imu):.3f} rad; {self.overlap:.2f} of its points agree."
        )

    def as_dict(self) -> dict[str, Any]:
        """Return position, heading and the two measures as plain numbers."""
        return {
            "position": self.T_world_imu[:3, 3].tolist(),
            "heading": heading_of(self.T_world_imu),
            "overlap": self.overlap,
            "fitness": self.fitness,
        }


class LocalisingStep(CompiledStep):
    """The compiled functions of a recipe that begins at a pose in a known map."""

    def __init__(self, settings: Settings, known: KnownMap, start: FoundStart) -> None:
        """Look for the programs; those that are missing are compiled on first use.

        Args:
            settings: of the run.
            known: the map.
            start: of the first scan.
        """
        super().__init__(settings)
        assert isinstance(self.recipe, LocalisingRecipe)
        self.start = start
        self._T_world_imu = jaxlie.SE3.from_matrix(jnp.asarray(start.T_world_imu, state_dtype()))
        self._placed = programs(type(self.recipe).placed, self.recipe, donate=(1,))
        self._known = known
        self._first = self.pager()

    def init(self, imu: ImuBatch | None, velocity: NDArray[np.float64] | None = None) -> Any:
        """Return the state before the first scan: at its pose in the map, with the map around it."""
        state = super().init(imu, velocity)
        return self._first.filled(self._placed(self.params, state, self._T_world_imu))

    def pager(self) -> MapPager:
        """Return what hands the map over during a new run."""
        assert isinstance(self.recipe, LocalisingRecipe)
        return MapPager(self._known, self.recipe, self.params, self.start.T_world_imu[:3, 3])


def step_of(sequence: Sequence, settings: Settings, imu: ImuData | None, first: int = 0) -> CompiledStep:
    """Return the compiled functions of a run, in the known map that its settings name or in its own map.

    Args:
        sequence: the recording.
        settings: of the run, resolved.
        imu: its inertial samples; None where there are none or the recipe does without.
        first: number of the first scan.

    Raises:
        UsageError: the recipe cannot begin in a known map.
        LioJaxError: the map cannot be read, or the first scan does not fit it.
    """
    config = settings.run.known_map
    if not config.path:
        return CompiledStep(settings)
    if not isinstance(recipe_of(settings), LocalisingRecipe):
        raise UsageError(
            f"config.known_map.path: the recipe {settings.recipe} cannot begin in a known map; use default."
        )
    path = Path(config.path)
    known = KnownMap.read(path)
    driven = driven_path(path) if config.search else None
    return LocalisingStep(settings, known, localise(sequence, known, settings, imu, driven, first))


def check_no_known_map(settings: Settings, user: str) -> None:
    """Refuse settings with a known map where it would have no effect.

    Raises:
        UsageError: ``config.known_map.path`` is given.
    """
    if settings.run.known_map.path:
        raise UsageError(f"config.known_map.path has no effect on {user}; leave it out.")


def localise(
    sequence: Sequence,
    known: KnownMap,
    settings: Settings,
    imu: ImuData | None = None,
    path: NDArray[np.float64] | None = None,
    first: int = 0,
) -> FoundStart:
    """Return the pose of a recording's first scan in a known map.

    Candidates are found by upright objects seen from above, near ``params.known_map`` or along a path, and
    are aligned with the map by its planes. The best one must have the overlap that a loop must have
    (``params.loop.overlap``).

    Args:
        sequence: the recording.
        known: the map.
        settings: ``params.known_map``, ``params.loop``, ``config.loops`` and those of the recipe.
        imu: inertial samples, which level the scan; None: the vehicle is taken as level.
        path: (k, 3) positions in the map's world along which to search, m; None: near ``params.known_map``.
        first: number of the first scan.

    Raises:
        LioJaxError: no scan has enough points, no place fits, or two places fit as well.
    """
    fed = _first_usable(sequence, settings, imu, first)
    level, points = _levelled(fed, settings)
    start, limits = settings.values["known_map"], settings.values["loop"]
    position = np.asarray(start["position"], np.float64)
    if path is None:
        errors = start["position_error"], start["heading_error"]
        candidates = places_near(known, points, position, start["heading"], errors, settings)
    else:
        candidates = places_along(known, points, path, settings)
    where = "along the earlier run" if path is not None else f"near {position.round(1).tolist()}"
    if not candidates or candidates[0].overlap < limits["overlap"]:
        share = f"{candidates[0].overlap:.2f} of its points agree" if candidates else "nothing agrees"
        raise LioJaxError(
            f"{sequence.info.path}: the first scan does not fit the known map {where} ({share}, "
            f"{limits['overlap']:g} are needed); give the start by params.known_map.position and heading, or "
            "search for it by config.known_map.search=true."
        )
    best = candidates[0]
    if rival := _rival(candidates, limits["rival"]):
        here, there = (one.T_target_source[:3, 3].round(1).tolist() for one in (best, rival))
        raise LioJaxError(
            f"{sequence.info.path}: the first scan fits the known map at {here} and at {there}; give the "
            "start by params.known_map.position and heading, with small errors."
        )
    return FoundStart(best.T_target_source @ level, best.overlap, best.fitness)


_APART = 2.0
"""Distance above which two places are different, m."""


def _rival(candidates: list[Candidate], share: float) -> Candidate | None:
    """Return another place whose overlap is nearly that of the best."""
    best = candidates[0]
    for other in candidates[1:]:
        apart = np.linalg.norm(other.T_target_source[:3, 3] - best.T_target_source[:3, 3])
        if apart > _APART and other.overlap > share * best.overlap:
            return other
    return None


def _first_usable(sequence: Sequence, settings: Settings, imu: ImuData | None, first: int) -> ScanInput:
    """Return the first scan with which a run can begin."""
    inputs = InputsInTurn(settings, feed_of(imu, settings) if imu is not None else None)
    for scan in sequence.scans(first, _SCANS_TRIED):
        if (fed := inputs(scan)).usable:
            return fed
    raise LioJaxError(
        f"{sequence.info.path}: none of the first {_SCANS_TRIED} scans has enough points in range."
    )


def _levelled(fed: ScanInput, settings: Settings) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the attitude T_level_imu (4, 4) of a scan, and its points in level axes, m from the IMU."""
    step = CompiledStep(settings)
    nav = step.init(fed.before).nav
    level = np.eye(4)
    level[:3, :3] = pose_matrix(np.asarray(nav.T_world_imu.wxyz_xyz))[:3, :3]
    T_imu_lidar = pose_matrix(np.asarray(nav.T_imu_lidar.wxyz_xyz))
    raw = np.asarray(fed.scan.points, np.float64)[np.asarray(fed.scan.mask)]
    away, lidar = np.linalg.norm(raw, axis=1), settings.values["lidar"]
    raw = raw[(away > lidar["min_range"]) & (away < lidar["max_range"])]
    points = (raw @ T_imu_lidar[:3, :3].T + T_imu_lidar[:3, 3]) @ level[:3, :3].T
    return level, points.astype(np.float32)
