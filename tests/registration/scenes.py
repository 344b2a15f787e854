"""Analytic scenes: points on planes and poles, maps made of them, and scans of them from a known pose."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from scipy.spatial.transform import Rotation

from lio_jax.mapping.voxel_map import VoxelMap, anchor_of, empty_map, insert
from tests.params import DEFAULTS, Params, params_from_values

Surface = Callable[[np.random.Generator, int], np.ndarray]
"""Draws n points (n, 3) of a surface, m in world."""


def rectangle(corner, first_edge, second_edge) -> Surface:
    """Return a flat surface by a corner and its two edges, m."""
    corner, edges = np.asarray(corner, float), np.array([first_edge, second_edge], float)
    return lambda rng, n: corner + rng.random((n, 2)) @ edges


def pole(x: float, y: float, radius: float, bottom: float, top: float) -> Surface:
    """Return an upright cylinder's side."""

    def draw(rng: np.random.Generator, n: int) -> np.ndarray:
        angle = rng.uniform(0, 2 * np.pi, n)
        height = rng.uniform(bottom, top, n)
        return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle), height], -1)

    return draw


def box_room(length: float, width: float, height: float) -> list[Surface]:
    """Return floor, ceiling and four walls around the origin, the floor 1.5 m below it, turned by 0.2 rad."""
    x, y, low = length / 2, width / 2, -1.5
    turned = Rotation.from_euler("z", 0.2).as_matrix().T
    sides = [
        ([-x, -y, low], [length, 0, 0], [0, width, 0]),
        ([-x, -y, low + height], [length, 0, 0], [0, width, 0]),
        ([-x, -y, low], [length, 0, 0], [0, 0, height]),
        ([-x, y, low], [length, 0, 0], [0, 0, height]),
        ([-x, -y, low], [0, width, 0], [0, 0, height]),
        ([x, -y, low], [0, width, 0], [0, 0, height]),
    ]
    return [rectangle(*(np.asarray(part) @ turned for part in side)) for side in sides]


ROOM = box_room(14.0, 9.0, 4.0)
POLES_AND_WALLS = [
    rectangle([-25, -25, -1.7], [50, 0, 0], [0, 50, 0]),
    rectangle([-25, 8.3, -1.7], [50, 0, 0], [0, 0, 6]),
    *(
        pole(x, y, 0.12, -1.7, 4.0)
        for x, y in [(5.3, -4.1), (-7.2, -5.4), (12.1, 3.2), (-14.5, 2.3), (2.2, -12.4)]
    ),
]
GROUND = [rectangle([-40, -40, -1.7], [80, 0, 0], [0, 80, 0])]


def sample(surfaces: list[Surface], count: int, sigma: float, seed: int, reach: float = 1e3) -> np.ndarray:
    """Return ``count`` points spread over the surfaces by turns, noisy, within ``reach`` m of the origin."""
    rng = np.random.default_rng(seed)
    points = np.empty((0, 3))
    while len(points) < count:
        drawn = np.concatenate([surface(rng, count) for surface in surfaces])
        drawn = drawn[np.linalg.norm(drawn, axis=1) < reach]
        points = np.concatenate([points, rng.permutation(drawn)])
    return points[:count] + rng.normal(0, sigma, (count, 3))


def beams(elevations_deg: np.ndarray, columns: int) -> np.ndarray:
    """Return the unit vectors (n, 3) of a turning sensor's beams, column after column."""
    turns = np.arange(columns) * (2 * np.pi / columns)
    elevation, azimuth = np.meshgrid(np.radians(elevations_deg), turns)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)


def params_with(**paths: float) -> Params:
    """Return the default parameters with changes, for example ``lidar__range_sigma=0.02``."""
    values = {section: dict(leaves) for section, leaves in DEFAULTS.items()}
    for path, value in paths.items():
        section, name = path.split("__")
        assert name in values[section]
        values[section][name] = value
    return params_from_values(values)


def map_of(world_points: np.ndarray, params: Params, centre=(0.0, 0.0, 0.0), capacity=32768) -> VoxelMap:
    """Insert points (m in world) as one scan seen from ``centre``."""
    anchor, corner = anchor_of(jnp.asarray(centre, jnp.float64), params.map.voxel_size)
    points = jnp.asarray(world_points - np.asarray(corner), jnp.float32)
    return _map_of(points, anchor, params, capacity)


def _insert_twice(points: jax.Array, anchor: jax.Array, params: Params, capacity: int) -> VoxelMap:
    vmap, mask = empty_map(capacity), jnp.ones(points.shape[0], bool)
    size, reach = params.map.voxel_size.astype(jnp.float32), params.map.reach.astype(jnp.float32)
    for _ in range(2):
        vmap, _ = insert(vmap, points, mask, anchor, size, reach)
    return vmap


_map_of = jax.jit(_insert_twice, static_argnums=3)


def pose(translation, rotation_vector) -> jaxlie.SE3:
    return jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.exp(jnp.asarray(rotation_vector, jnp.float64)), jnp.asarray(translation, jnp.float64)
    )


def matrix(T: jaxlie.SE3) -> np.ndarray:
    return np.asarray(T.as_matrix())


def seen_from(T_world_lidar: jaxlie.SE3, world_points: np.ndarray) -> jax.Array:
    """Return the points in the lidar frame, float32."""
    T = np.linalg.inv(matrix(T_world_lidar))
    return jnp.asarray(world_points @ T[:3, :3].T + T[:3, 3], jnp.float32)


def pose_error(found: jaxlie.SE3, truth: jaxlie.SE3) -> tuple[float, float]:
    """Return translation (m) and rotation (deg) between two poses."""
    difference = np.linalg.inv(matrix(truth)) @ matrix(found)
    angle = Rotation.from_matrix(difference[:3, :3]).magnitude()
    return float(np.linalg.norm(difference[:3, 3])), float(np.rad2deg(angle))
