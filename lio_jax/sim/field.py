"""An open field: rolling ground, a few trees, posts and hay bales."""

import numpy as np

from lio_jax.sim.assembly import Terrain, assembled, draws
from lio_jax.sim.worlds import Route, Scene

_EXTENT = 110.0
"""Half the width of the field, m."""
_TREES, _POSTS, _BALES = 14, 10, 6
_ROUTE = np.array(
    [
        [-20.0, -40.0, 5.0],
        [30.0, -40.0, 6.0],
        [55.0, -20.0, 9.0],
        [50.0, 25.0, 7.0],
        [10.0, 10.0, 5.0],
        [-10.0, 45.0, 8.0],
        [-50.0, 30.0, 10.0],
        [-55.0, -30.0, 7.0],
    ]
)
"""Vertices (x, y, height above ground), m."""
_CLEAR = 6.0
"""Horizontal distance from the route within which nothing grows, m."""


def field(seed: int) -> Scene:
    """Return the field and a drone's flight over it; the flight's plan is the same for every seed."""
    rng = np.random.default_rng(seed)
    terrain = _terrain(rng)
    radius, height, crown, yaw, reflectivity = draws(
        rng, _TREES + _POSTS + _BALES, (0.15, 0.3), (2.5, 4.5), (1.5, 2.8), (0.0, np.pi), (0.2, 0.7)
    )
    position = _clear_positions(rng, _TREES + _POSTS + _BALES)
    ground = terrain.height(position) - 0.5
    tree, post, bale = np.split(np.arange(len(position)), [_TREES, _TREES + _POSTS])
    trunks = np.column_stack([position, ground, radius, height + 0.5, reflectivity])[tree]
    posts = np.column_stack([position, ground, radius / 3, np.full(len(position), 2.3), reflectivity])[post]
    crowns = np.column_stack([position, ground + height + 0.7 * crown, crown, reflectivity])[tree]
    size = np.tile([1.2, 0.8, 1.0], (len(position), 1))
    bales = np.column_stack([position, ground + 0.6, size, yaw, reflectivity])[bale]
    route = _ROUTE + np.column_stack([np.zeros((len(_ROUTE), 2)), terrain.height(_ROUTE[:, :2])])
    world = assembled(
        route[0],
        terrain=terrain,
        boxes=bales,
        cylinders=np.concatenate([trunks, posts]),
        spheres=crowns,
    )
    return Scene(world, Route(route - route[0], closed=True, radius=10.0, speed=5.0, dynamics="drone"))


def _terrain(rng: np.random.Generator) -> Terrain:
    heading = rng.uniform(0.0, np.pi) + np.array([0.0, 1.2, 2.1])
    number = 2 * np.pi / np.array([180.0, 110.0, 45.0])
    wave = number[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return Terrain(np.array([1.8, 0.8, 0.2]), wave, rng.uniform(0, 2 * np.pi, 3), 0.25)


def _clear_positions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return positions (count, 2) away from the route's polyline, m."""
    begin, end = _ROUTE[:, :2], np.roll(_ROUTE[:, :2], -1, axis=0)
    along = end - begin
    chosen: list[np.ndarray] = []
    while len(chosen) < count:
        point = rng.uniform(-_EXTENT, _EXTENT, 2)
        share = np.clip(np.sum((point - begin) * along, axis=1) / np.sum(along**2, axis=1), 0, 1)
        if np.linalg.norm(begin + share[:, None] * along - point, axis=1).min() > _CLEAR:
            chosen.append(point)
    return np.array(chosen)
