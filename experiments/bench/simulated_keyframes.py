"""Keyframes of drives through simulated worlds, without an odometry: a formula adds the drift."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.loops.keyframe import Keyframe, thinned
from lio_jax.sim.lidar import Lidar, Sweep, spinning_lidar, sweep
from lio_jax.sim.raycast import cast
from lio_jax.sim.worlds import Counts, World, counts_along, nearest_part

_Array = NDArray[np.float64]

SPARSE = spinning_lidar(16, 512, elevation_deg=(-15.0, 15.0))
"""A lidar with 16 beams and 512 columns in a turn."""
_BODY_HEIGHT = 1.6
_SPACING = 0.4
_COVARIANCE = np.diag([1e-3**2] * 3 + [1e-2**2] * 3)
"""Covariance of a step, as a run uses it by default (rotation rad, translation m)."""


def rounded(vertices: Sequence[Sequence[float]], radius: float = 7.0, spacing: float = 1.0) -> _Array:
    """Return points with the given spacing on a closed polygon with rounded corners, (n, 2) m.

    Args:
        vertices: (k, 2) m, in driving order.
        radius: radius of the corners, m.
        spacing: distance between the points, m.
    """
    corners = np.asarray(vertices, np.float64)
    fine = []
    for before, corner, after in zip(np.roll(corners, 1, 0), corners, np.roll(corners, -1, 0), strict=True):
        arrive, leave = ((away - corner) / np.linalg.norm(away - corner) * radius for away in (before, after))
        share = np.linspace(0, 1, 20)[:, None]
        # a quadratic curve that is tangent to both sides
        fine.append(corner + (1 - share) ** 2 * arrive + share**2 * leave)
    path = np.concatenate([*fine, fine[0][:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    wanted = np.arange(0.0, along[-1], spacing)
    return np.stack([np.interp(wanted, along, path[:, axis]) for axis in range(2)], axis=1)


def driven(world: World, path: _Array, aside: float = 0.0, above: float = 8.0) -> _Array:
    """Return the poses T_world_imu of a body that drives along a path, (n, 4, 4).

    Args:
        world: the world on whose ground it drives.
        path: (n, 2) m, world frame.
        aside: offset to the left of the path, m.
        above: a height in the world with only the ground below it along the path, m.
    """
    ahead = np.gradient(path, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    path = path + aside * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    poses = np.tile(np.eye(4), (len(path), 1, 1))
    height = _ground(world, path, above) + _BODY_HEIGHT
    slope = np.gradient(height) / np.linalg.norm(np.gradient(path, axis=0), axis=1)
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    poses[:, :3, :3] = Rotation.from_euler(
        "ZYX", np.stack([heading, -np.arctan(slope), np.zeros_like(slope)], axis=1)
    ).as_matrix()
    poses[:, :2, 3], poses[:, 2, 3] = path, height
    return poses


def drifted(poses: _Array, scale: float, heading: float, noise: float = 0.0, seed: int = 0) -> _Array:
    """Return true poses with the drift of a bad odometry, (n, 4, 4), level like those of an inertial one.

    Args:
        poses: (n, 4, 4) T_world_imu.
        scale: relative error of its distances, positive for too long ones.
        heading: error of its heading, rad per m.
        noise: standard deviation of its position after 1 m, m; it grows with the root of the distance.
        seed: seed of the noise.
    """
    rng = np.random.default_rng(seed)
    steps = np.diff(poses[:, :3, 3], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    turned = np.concatenate([[0.0], np.cumsum(lengths * heading)])
    turn = Rotation.from_euler("z", turned[:, None]).as_matrix()
    noisy = (1 + scale) * steps + noise * np.sqrt(lengths)[:, None] * rng.normal(size=steps.shape)
    result = poses.copy()
    result[:, :3, :3] = turn @ poses[:, :3, :3]
    result[1:, :3, 3] = poses[0, :3, 3] + np.cumsum(np.einsum("nij,nj->ni", turn[:-1], noisy), axis=0)
    return result


def times_along(poses: _Array, speed: float = 8.0) -> _Array:
    """Return the times at which a body with constant speed passes poses, (n,) s from the first."""
    way = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(way)]) / speed


def keyframes_of(
    world: World, poses: _Array, odometry: _Array, times: _Array, lidar: Lidar = SPARSE, seed: int = 0
) -> list[Keyframe]:
    """Return the keyframes with the scans from consecutive poses, (k,).

    Args:
        world: the world that is scanned.
        poses: (k, 4, 4) T_world_imu; lidar and IMU coincide.
        odometry: (k, 4, 4) poses of the keyframes by the odometry.
        times: (k,) s, times of the poses.
        lidar: the sensor; it stands still during a sweep.
        seed: seed of the sensor's noise.
    """
    keyframes = []
    with jax.enable_x64(True):
        found = counts_along(world, jnp.asarray(poses[:, :3, 3]), 101.0)
        counts = Counts(*(-(-int(count) // 16) * 16 for count in found))
        key = jax.random.key(seed)
        for index, (pose, time) in enumerate(zip(poses, times, strict=True)):
            seen = _seen(
                world, counts, lidar, jnp.asarray(pose), jnp.float64(time), jax.random.fold_in(key, index)
            )
            points = np.asarray(seen.points)[np.asarray(seen.mask)]
            keyframes.append(
                Keyframe(
                    index=index,
                    stamp_ns=round(time * 1e9),
                    T_odom_imu=odometry[index],
                    points=thinned(points, _SPACING),
                    covariance=_COVARIANCE,
                )
            )
    return keyframes


@eqx.filter_jit
def _seen(
    world: World,
    counts: Counts,
    lidar: Lidar,
    pose: Float[Array, "4 4"],
    time: Float[Array, ""],
    key: PRNGKeyArray,
) -> Sweep:
    part, _ = nearest_part(world, pose[:3, 3], time, counts)
    rotation = jaxlie.SO3.from_matrix(pose[:3, :3]).wxyz
    still = jnp.tile(jnp.concatenate([rotation, jnp.zeros(3)]), (lidar.columns, 1))
    return sweep(lidar, part, jaxlie.SE3(still), key)


def _ground(world: World, path: _Array, above: float) -> _Array:
    """Return the height of the surface below, (n,) m."""
    with jax.enable_x64(True):
        counts = counts_along(world, jnp.asarray(np.pad(path, ((0, 0), (0, 1)))), 1.0)
        return np.asarray(_below(world, counts, jnp.asarray(path), jnp.float64(above)))


@eqx.filter_jit
def _below(
    world: World, counts: Counts, path: Float[Array, "n 2"], above: Float[Array, ""]
) -> Float[Array, " n"]:
    def one(place: Float[Array, "2"]) -> Float[Array, ""]:
        part, _ = nearest_part(world, jnp.append(place, above), jnp.float64(0.0), counts)
        down = jnp.array([[0.0, 0.0, -1.0]])
        return above - cast(part, jnp.zeros((1, 3)), down, jnp.zeros(1)).distance[0]

    return jax.lax.map(one, path)
