"""Roads of any bend for drives that start at any speed: streets, city blocks and motorways."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.assembly import assembled
from lio_jax.sim.worlds import Route, Scene

Kind = Literal["street", "city", "motorway"]

_BEHIND, _AHEAD = 150.0, 250.0
"""Length of the furnished road behind the start and ahead of it, m."""
_HEIGHT = 1.5
"""Height of the body above the ground, m."""
_CLEAR = 3.0
"""Half width of the lane in which nothing stands, m."""
_STEP_S = 0.01


class Road:
    """A road that bends with one curvature where it is driven, and is straight before and behind."""

    def __init__(self, curvature: float, driven: float) -> None:
        """Lay the middle line.

        Args:
            curvature: 1/m, positive to the left.
            driven: length of the bend, m.
        """
        self.along = np.arange(-_BEHIND, _AHEAD, 0.1)
        bends = (self.along > -3) & (self.along < driven + 3)
        self.heading = np.cumsum(np.where(bends, curvature, 0.0)) * 0.1
        self.heading -= np.interp(0.0, self.along, self.heading)
        step = 0.1 * np.stack([np.cos(self.heading), np.sin(self.heading)], axis=1)
        self.line = np.cumsum(step, axis=0)
        self.line -= self.at(np.zeros(1), np.zeros(1))[0][0]
        self.driven = driven

    def at(self, along: NDArray, left: NDArray) -> tuple[NDArray, NDArray]:
        """Return positions (n, 2) and headings (n,) at distances along the road and to its left, m."""
        place = np.stack([np.interp(along, self.along, axis) for axis in self.line.T], axis=1)
        heading = np.interp(along, self.along, self.heading)
        normal = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        return place + left[:, None] * normal, heading

    def is_clear(self, places: NDArray, reach: NDArray) -> NDArray:
        """Return which bodies of a radius stay off the lane that is driven."""
        lane = self.line[(self.along > -10) & (self.along < self.driven + 30)][::5]
        gap = np.linalg.norm(places[:, None] - lane, axis=2).min(axis=1)
        return gap > _CLEAR + reach


class _Furniture:
    def __init__(self, road: Road, rng: np.random.Generator) -> None:
        self._road, self._rng = road, rng
        self.boxes: list[NDArray] = []
        self.cylinders: list[NDArray] = []

    def row(self, pitch: float, left: tuple[float, float], share: float) -> tuple[NDArray, NDArray, int]:
        """Return places, headings and number of bodies on both sides, drawn with a probability."""
        rng = self._rng
        along = np.arange(-_BEHIND + 2, _AHEAD - 2, pitch)
        along = np.concatenate([along, along]) + rng.uniform(-0.25, 0.25, 2 * len(along)) * pitch
        side = np.repeat([1.0, -1.0], len(along) // 2)
        present = rng.uniform(size=len(along)) < share
        along, side = along[present], side[present]
        places, heading = self._road.at(along, side * rng.uniform(*left, len(along)))
        return places, heading, len(along)

    def add_boxes(self, pitch: float, left: tuple, share: float, *size: tuple[float, float]) -> None:
        """Add boxes of drawn length, width and height."""
        places, heading, count = self.row(pitch, left, share)
        length, width, height = (self._rng.uniform(*one, count) for one in size)
        clear = self._road.is_clear(places, np.hypot(np.minimum(length, 4 * width), width) / 2)
        rows = np.column_stack(
            [
                places,
                height / 2,
                length / 2,
                width / 2,
                height / 2,
                heading,
                self._rng.uniform(0.2, 0.8, count),
            ]
        )
        self.boxes.append(rows[clear])

    def add_cylinders(self, pitch: float, left: tuple, share: float, *size: tuple[float, float]) -> None:
        """Add cylinders of drawn radius and height."""
        places, _, count = self.row(pitch, left, share)
        radius, height = (self._rng.uniform(*one, count) for one in size)
        rows = np.column_stack([places, np.zeros(count), radius, height, self._rng.uniform(0.2, 0.8, count)])
        self.cylinders.append(rows[self._road.is_clear(places, radius)])


def road_scene(kind: Kind, curvature: float, driven: float, seed: int) -> Scene:
    """Return a furnished road, whose middle line starts at the world's origin along x.

    Args:
        kind: street: houses, trees, poles and parked cars; city: higher and closer houses; motorway: guard
            rails, few posts and trees.
        curvature: of the part that is driven, 1/m.
        driven: its length, m.
        seed: of everything that stands beside it.
    """
    road, rng = Road(curvature, driven), np.random.default_rng([seed, len(kind)])
    furniture = _Furniture(road, rng)
    if kind == "motorway":
        for left in (-14.0, -5.5, 5.5, 14.0):
            along = np.arange(-_BEHIND + 2, _AHEAD - 2, 4.0)
            places, heading = road.at(along, np.full(len(along), left))
            clear = road.is_clear(places, np.full(len(along), 0.5))
            size = np.tile([0.55, 2.0, 0.05, 0.2], (len(along), 1))
            rails = np.column_stack([places, size, heading, np.full(len(along), 0.6)])
            furniture.boxes.append(rails[clear])
            posts = np.column_stack([places, np.tile([0.0, 0.06, 0.75, 0.6], (len(along), 1))])
            furniture.cylinders.append(posts[clear])
        furniture.add_cylinders(50.0, (15.0, 16.0), 0.6, (0.05, 0.1), (3.0, 8.0))
        furniture.add_cylinders(20.0, (18.0, 45.0), 0.7, (0.15, 0.35), (4.0, 9.0))
    else:
        near, height = ((9.0, 12.0), (6.0, 12.0)) if kind == "street" else ((8.0, 9.0), (12.0, 30.0))
        depth = (8.0, 10.0)
        setback = near[0] + depth[1] / 2, near[1] + depth[1] / 2
        furniture.add_boxes(15.0, setback, 0.85, (8.0, 14.5), depth, height)
        furniture.add_boxes(7.0, (5.0, 5.6), 0.45, (3.8, 4.8), (1.7, 1.9), (1.4, 1.9))
        furniture.add_cylinders(18.0, (6.5, 7.0), 0.7, (0.06, 0.25), (4.0, 8.0))
    world = assembled(
        [0.0, 0.0, _HEIGHT],
        planes=[[0, 0, 0, 0, 0, 1, 0.2]],
        boxes=np.concatenate(furniture.boxes),
        cylinders=np.concatenate(furniture.cylinders),
    )
    ends, _ = road.at(np.array([0.0, driven]), np.zeros(2))
    points = np.column_stack([ends, np.zeros(2)])
    return Scene(world, Route(points, closed=False, radius=5.0, speed=5.0, dynamics="car"))


def driven_along(curvature: float, speed: float, seconds: float) -> Trajectory:
    """Return the motion at constant speed along :func:`road_scene`'s middle line, with a car's sway."""
    time = np.arange(0.0, seconds + 2 * _STEP_S, _STEP_S)
    heading = curvature * speed * time
    half = heading / 2
    # the chord of an arc; numpy's sinc is that of pi x
    places = (speed * time * np.sinc(half / np.pi))[:, None] * np.stack([np.cos(half), np.sin(half)], axis=1)
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(heading)
    poses[:, 1, 0] = np.sin(heading)
    poses[:, 0, 1] = -np.sin(heading)
    poses[:, :2, 3] = places
    poses[:, 2, 3] = 0.01 * np.sin(2 * np.pi * 1.3 * time)
    return Trajectory(np.round(time * 1e9).astype(np.int64), poses)
