"""Find the place of one scan in a map: near a guess, or along the path that made the map."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.overlap import Candidate
from lio_jax.loops.params import BackEndSettings
from lio_jax.loops.place_descriptor import DescribedPlaces, Likeness
from lio_jax.loops.verification import SOURCE_REACH, TARGET_REACH, Guess, compare

_Array = NDArray[np.float64]

_STATION_SPACING = 5.0
"""Distance between the places of the path that are compared, m."""
_ALIGNED_PLACES = 5
"""Number of the most similar places at which the scan is aligned."""
_SIMILAR_SHIFT = 8.0
"""Largest distance from a similar place at which the scan is searched, m."""


@runtime_checkable
class MapPoints(Protocol):
    """The points of a map."""

    def around(self, position: _Array, reach: float) -> NDArray[np.float32]:
        """Return the points with |x| and |y| below ``reach`` from a position, (n, 3) m from there."""
        ...


def places_near(
    known: MapPoints,
    scan: NDArray[np.float32],
    position: _Array,
    heading: float,
    errors: tuple[float, float],
    settings: BackEndSettings,
) -> list[Candidate]:
    """Return the places of a scan near a guess, the one with the most overlap first.

    The pose of a candidate is T_world_level, that of the scan's level axes in the map's world.

    Args:
        known: the map.
        scan: (n, 3) points, m, from the IMU, in level axes.
        position: (3,) guess of the IMU's position in the map's world, m.
        heading: guess of the heading of the scan's x axis, rad.
        errors: largest horizontal error of the position, m, and of the heading, rad.
        settings: ``config.loops`` and ``params.loop``.
    """
    shift_error, turn_error = errors
    near = scan[np.abs(scan[:, :2]).max(axis=1, initial=0) < SOURCE_REACH]
    guess = Guess(heading, turn_error, np.zeros(2), shift_error)
    found = compare(known.around(position, TARGET_REACH), near, guess, settings).candidates
    return [replace(one, T_target_source=_moved(one.T_target_source, position)) for one in found]


def _moved(pose: _Array, by: _Array) -> _Array:
    moved = pose.copy()
    moved[:3, 3] += by
    return moved


def places_along(
    known: MapPoints, scan: NDArray[np.float32], path: _Array, settings: BackEndSettings
) -> list[Candidate]:
    """Return the places of a scan along a path, the one with the most overlap first.

    The places of the path that look like the scan are searched (:mod:`lio_jax.loops.place_descriptor`).

    Args:
        known: the map.
        scan: (n, 3) points, m, from the IMU, in level axes.
        path: (k, 3) positions in the map's world, m.
        settings: ``config.loops`` and ``params.loop``.
    """
    stations = _stations(path)
    likeness = _likeness(known, scan, stations, settings)
    turn_error = 2 * np.pi / settings.run.loops.sectors
    found: list[Candidate] = []
    for row in np.argsort(likeness.distance, kind="stable")[:_ALIGNED_PLACES]:
        position, turn = stations[likeness.index[row]], float(likeness.turn[row])
        found += places_near(known, scan, position, turn, (_SIMILAR_SHIFT, turn_error), settings)
    return sorted(found, key=lambda candidate: -candidate.overlap)


def _stations(path: _Array) -> _Array:
    """Return positions of a path that are some metres apart, also where it comes back to a place."""
    path = path[np.isfinite(path).all(axis=1)]
    cells = np.floor(path[:, :2] / _STATION_SPACING).astype(np.int64)
    return path[np.sort(np.unique(cells, axis=0, return_index=True)[1])]


def _likeness(
    known: MapPoints, scan: NDArray[np.float32], stations: _Array, settings: BackEndSettings
) -> Likeness:
    sizes, reach = settings.run.loops, float(settings.values["loop"]["descriptor_range"])
    places = DescribedPlaces(sizes.rings, sizes.sectors, reach)
    for station in stations:
        places.add(_level_keyframe(known.around(station, reach)))
    places.add(_level_keyframe(scan))
    poses = np.tile(np.eye(4), (len(stations) + 1, 1, 1))
    poses[:-1, :3, 3] = stations
    return places.compared(poses, np.arange(len(stations)), np.full(len(stations), np.pi))


def _level_keyframe(points: NDArray[np.float32]) -> Keyframe:
    return Keyframe(index=0, stamp_ns=0, T_odom_imu=np.eye(4), points=points, covariance=np.zeros((6, 6)))
