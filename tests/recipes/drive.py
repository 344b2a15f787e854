"""A sensor that moves with constant velocity through a hall: every pose is known in closed form."""

from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from scipy.linalg import expm

from lio_jax.core.leaf import numbers_of, traced
from lio_jax.core.types import Scan
from lio_jax.mapping.params import MapConfig
from lio_jax.recipes.default import Default, DefaultState
from lio_jax.recipes.default_params import DefaultConfig, DefaultParams, ThinnedScanConfig
from lio_jax.recipes.recipe import Output
from lio_jax.sim.assembly import assembled
from lio_jax.sim.lidar import column_times, spinning_lidar, sweep
from lio_jax.sim.worlds import Counts, World, nearest_part

PERIOD, BEAMS, COLUMNS = 0.1, 16, 256
CONFIG = DefaultConfig(
    lidar=ThinnedScanConfig(buckets=(BEAMS * COLUMNS,), registration_points=2048, insertion_points=4096),
    map=MapConfig(capacity=16384),
)
LIDAR = spinning_lidar(BEAMS, COLUMNS, elevation_deg=(-20.0, 15.0), range_sigma=0.01)
TWIST = np.array([6.0, 0.3, 0.1, 0.02, -0.03, 0.3])
"""Twist of the lidar in its own frame: m/s, then rad/s."""


def hall() -> World:
    """Return a hall of 34 x 22 x 7 m with crates and columns, the sensor's start at the origin."""
    sides = zip(np.eye(3), (17, 11, 3.5), strict=True)
    walls = [[*(sign * size * axis), *(-sign * axis), 0.5] for axis, size in sides for sign in (-1, 1)]
    crates = [
        [7.3, 4.1, -2.5, 1.2, 0.8, 1.0, 0.3, 0.5],
        [-6.2, -5.3, -2.0, 0.9, 1.6, 1.5, 1.1, 0.5],
        [11.0, -6.4, -2.2, 1.5, 1.1, 1.3, -0.6, 0.5],
        [-10.5, 6.2, -1.5, 1.0, 1.0, 2.0, 0.8, 0.5],
        [2.5, -8.0, -2.6, 2.0, 0.7, 0.9, 0.1, 0.5],
    ]
    columns = [[x, y, -3.5, 0.3, 7.0, 0.5] for x, y in ((5.0, -4.0), (-5.0, 5.0), (12.0, 3.0), (-12.0, -2.0))]
    return assembled([0.0, 0.0, 0.0], planes=walls, boxes=crates, cylinders=columns)


WORLD = hall()
_PART = nearest_part(WORLD, jnp.zeros(3, jnp.float32), jnp.float32(0), Counts(5, 0, 4, 0))[0]


def moved(twist: np.ndarray, seconds: float) -> np.ndarray:
    """Return the (4, 4) motion of a constant twist, by scipy's matrix exponential."""
    (vx, vy, vz), (wx, wy, wz) = twist[:3], twist[3:]
    return expm(seconds * np.array([[0, -wz, wy, vx], [wz, 0, -wx, vy], [-wy, wx, 0, vz], [0, 0, 0, 0]]))


def lidar_pose(seconds: float, twist: np.ndarray = TWIST) -> np.ndarray:
    """Return the lidar's (4, 4) pose in the hall ``seconds`` after the first scan began."""
    return moved(np.asarray(twist), seconds)


@jax.jit
def _turn(poses: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    turn = sweep(LIDAR, _PART, jaxlie.SE3.from_matrix(poses), key)
    return turn.points.reshape(-1, 3), turn.mask.reshape(-1)


@cache
def _measured(number: int, twist: tuple[float, ...], still: bool) -> tuple[np.ndarray, np.ndarray]:
    times = number * PERIOD + np.asarray(column_times(LIDAR), float)
    if still:
        times = np.full_like(times, (number + 1) * PERIOD)
    poses = np.stack([lidar_pose(t, np.array(twist)) for t in times])
    with jax.enable_x64(True):
        points, mask = _turn(jnp.asarray(poses, jnp.float32), jax.random.key(number))
    return np.asarray(points), np.asarray(mask)


def scan(number: int, interval: float | None = None, twist: np.ndarray = TWIST, still: bool = False) -> Scan:
    """Return turn ``number``, which lasts from number * PERIOD on.

    Args:
        number: of the turn.
        interval: since the last scan's end, s; None: 0 for the first, one period for the others.
        twist: of the lidar.
        still: a compensated sweep: as if all points had been measured at the turn's end.
    """
    points, mask = _measured(number, tuple(np.asarray(twist).tolist()), still)
    times = np.repeat(np.asarray(column_times(LIDAR), np.float32), BEAMS)
    if interval is None:
        interval = PERIOD if number else 0.0
    return Scan(
        points=jnp.asarray(points),
        time=jnp.asarray(0 * times if still else times),
        ring=jnp.asarray(np.tile(np.arange(BEAMS, dtype=np.int32), COLUMNS)),
        intensity=jnp.zeros(len(points), jnp.float32),
        mask=jnp.asarray(mask),
        duration=jnp.float32(0.0 if still else PERIOD),
        interval=jnp.float32(interval),
    )


HALL = {
    "lidar__min_range": 0.5,
    "map__point_spacing": 0.3,
    "registration__point_spacing": 0.7,
    "registration__kernel": 0.2,
}
"""Settings that differ from the defaults: the hall is small, and so are the capacities."""


def params_with(**paths: float | list[float]) -> DefaultParams:
    """Return default parameters fit for the hall, with changes, for example ``map__reach=50.0``."""
    values = {section: dict(leaves) for section, leaves in numbers_of(DefaultParams).items()}
    for path, value in {**HALL, **paths}.items():
        section, name = path.split("__")
        assert name in values[section]
        values[section][name] = value
    return traced(DefaultParams, values)


PARAMS = params_with()
STEP = jax.jit(Default(CONFIG).step)
"""Compiled once for all tests: parameters and scans are traced."""


def initial(params: DefaultParams = PARAMS) -> DefaultState:
    return Default(CONFIG).init(params)


@dataclass
class Step:
    """The results of one step."""

    state: DefaultState
    output: Output

    @property
    def T_world_imu(self) -> np.ndarray:
        """(4, 4)."""
        return np.asarray(self.state.nav.T_world_imu.as_matrix())


def run(scans: list[Scan], params: DefaultParams = PARAMS) -> list[Step]:
    """Feed scans one after another."""
    state, steps = initial(params), []
    for item in scans:
        state, output = STEP(params, state, item)
        steps.append(Step(state, output))
    return steps


def distance_to_hall(points: np.ndarray) -> np.ndarray:
    """Return the distance (m) of points (n, 3) in the hall's frame to its nearest surface."""
    walls = np.abs(np.abs(points) - [17, 11, 3.5]).min(1)
    found = [walls]
    for x, y in np.asarray(WORLD.solids.cylinders.base)[:, :2]:
        found.append(np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - 0.3))
    boxes = WORLD.solids.boxes
    for centre, half, yaw in zip(*map(np.asarray, (boxes.center, boxes.half_size, boxes.yaw)), strict=True):
        cos, sin = np.cos(yaw), np.sin(yaw)
        local = (points - centre) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        outside = np.abs(local) - half
        found.append(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.abs(np.minimum(outside.max(1), 0)))
    return np.min(found, 0)


def apart(found: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Return distance (m) and angle (deg) between two poses."""
    difference = np.linalg.inv(expected) @ found
    angle = np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1))
    return float(np.linalg.norm(difference[:3, 3])), float(np.rad2deg(angle))


def expected_pose(seconds: float, twist: np.ndarray = TWIST) -> np.ndarray:
    """Return T_world_lidar in the estimator's world.

    Its origin is where the lidar was in the middle of the first scan, because that is the instant a scan is
    registered for and the velocity is not known yet.
    """
    return np.linalg.inv(lidar_pose(PERIOD / 2, twist)) @ lidar_pose(seconds, twist)
