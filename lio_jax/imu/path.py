"""The motion between two filter states at every instant, for deskewing."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int32

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.xla import computed_once
from lio_jax.imu.rotation_integrals import SERIES_LIMIT, rotation_series


class Path(eqx.Module):
    """Poses at k knots; between them the rate and the specific force in the IMU frame are constant.

    Before the first knot and after the last one, the rate and the force are those of the nearest interval.
    """

    time: Float[Array, " k"]
    """Time of each knot, s from the scan's start, not descending."""
    T_world_imu: jaxlie.SE3
    """Pose at each of the k knots, m."""
    velocity: Float[Array, "k 3"]
    """Velocity of the IMU's origin at each knot, m/s, in world."""
    rate: Float[Array, "n 3"]
    """Angular rate in each of the k - 1 intervals, bias removed, rad/s, IMU frame."""
    accel: Float[Array, "n 3"]
    """Specific force in each of the k - 1 intervals, bias removed, m/s^2, IMU frame."""
    gravity: Float[Array, "3"]
    """Acceleration of gravity, m/s^2, in world; zero where nothing was measured: the velocity is constant."""


def pose_at(path: Path, time: Float[Array, " n"]) -> jaxlie.SE3:
    """Return T_world_imu at n instants, exact for the path's constant inputs.

    Args:
        path: k knots; its dtype is that of the result.
        time: s from the scan's start.
    """
    interval = _interval_at(path.time, time)
    delay = time.astype(path.time.dtype) - path.time[interval]
    position = _carried(_motion(path, jaxlie.SE3.identity()), time, jnp.zeros((len(delay), 3), delay.dtype))
    turn = jaxlie.SO3.exp(path.rate[interval] * delay[:, None])
    rotation = (jaxlie.SO3(path.T_world_imu.wxyz_xyz[interval, :4]) @ turn).normalize()
    return jaxlie.SE3.from_rotation_and_translation(rotation, position)


def carry(path: Path, time: Float[Array, " n"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return ``pose_at(path, time) @ points`` without a pose per point.

    Args:
        path: k knots.
        time: time of each point, s from the scan's start.
        points: m, each in the IMU frame at its own time.

    Returns:
        The points in world, m.
    """
    return _carried(_motion(path, jaxlie.SE3.identity()), time, points)


def deskew_along(
    path: Path, T_imu_lidar: jaxlie.SE3, points: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Express points in the lidar frame of the path's last knot, in the points' dtype.

    Args:
        path: reaches from before the first point to the scan's end.
        T_imu_lidar: pose of the lidar in the IMU frame.
        points: m, lidar frame at each point's own firing time.
        time: firing time from the scan's start, s.
    """
    last = jaxlie.SE3(path.T_world_imu.wxyz_xyz[-1]) @ T_imu_lidar
    # the last lidar frame in place of the world: the arithmetic in float32 stays near the origin
    near = _seen_from(last, _motion(path, T_imu_lidar))
    return _carried(jax.tree.map(lambda x: x.astype(points.dtype), near), time, points)


_Triple = tuple[Array, Array, Array]
"""The components x, y and z of n vectors. They are separate arrays, because XLA's loops over (n, 3) compute
each component three times."""


class _Motion(eqx.Module):
    """The path of a body that is fixed to the IMU, as vectors in one frame."""

    time: Float[Array, " k"]
    """Time of each knot, s from the scan's start."""
    vectors: Float[Array, "n 8 3"]
    """Vectors at the start of each of the k - 1 intervals: the body's axes x, y and z, its origin from the
    IMU's (m), angular rate (rad/s), specific force (m/s^2), the IMU's position (m) and velocity (m/s)."""
    gravity: Float[Array, "3"]
    """Acceleration of gravity, m/s^2."""


def _motion(path: Path, T_imu_body: jaxlie.SE3) -> _Motion:
    """Return the motion of a body along the path, in world axes."""
    axes = jnp.swapaxes(rotation_matrix(path.T_world_imu.rotation()), 1, 2)[:-1]
    body = jnp.concatenate([rotation_matrix(T_imu_body.rotation()).T, T_imu_body.translation()[None]])
    held = jnp.broadcast_to(body, (len(axes), 4, 3))
    turning = jnp.concatenate([held, path.rate[:, None], path.accel[:, None]], axis=1) @ axes
    start = jnp.stack([path.T_world_imu.translation(), path.velocity], axis=1)[:-1]
    return _Motion(path.time, jnp.concatenate([turning, start], axis=1), path.gravity)


def _seen_from(T_world_ref: jaxlie.SE3, motion: _Motion) -> _Motion:
    """Return a motion that is given in world in the frame ``ref`` instead."""
    R_world_ref = rotation_matrix(T_world_ref.rotation())
    moved = motion.vectors.at[:, 6].add(-T_world_ref.translation())
    return _Motion(motion.time, moved @ R_world_ref, motion.gravity @ R_world_ref)


def _interval_at(knots: Float[Array, " k"], time: Float[Array, " n"]) -> Int32[Array, " n"]:
    return jnp.sum(knots[1:-1] <= time[:, None], axis=1, dtype=jnp.int32)


def _carried(motion: _Motion, time: Float[Array, " n"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return points, given in the body frame at their own times, in the motion's frame.

    With w = h rate the rotated point is p + a w x p + b w x (w x p), where p and the rate are in the axes of
    the motion. The second integral of the rotating specific force has the same form.
    """
    interval = _interval_at(motion.time, time)
    # a single gather of whole rows
    rows = motion.vectors.reshape(-1, 24)[interval]
    h = time.astype(rows.dtype) - motion.time[interval]
    x_axis, y_axis, z_axis, arm, rate, force, position, velocity = (_triple(rows, 3 * i) for i in range(8))
    x, y, z = points.T
    p = _each(lambda i: x * x_axis[i] + y * y_axis[i] + z * z_axis[i] + arm[i])
    w = _each(lambda i: h * rate[i])
    # computed once, and not for each column again
    a, b, c, d = computed_once(rotation_series(jnp.minimum(sum(x**2 for x in w), SERIES_LIMIT)))
    turned, pushed = _cross(w, p), _cross(w, force)
    twice, pushed_twice = _cross(w, turned), _cross(w, pushed)

    def column(i: int) -> Array:
        fallen = position[i] + h * (velocity[i] + h / 2 * motion.gravity[i])
        driven = h**2 * (force[i] / 2 + c * pushed[i] + d * pushed_twice[i])
        return fallen + driven + p[i] + a * turned[i] + b * twice[i]

    return jnp.stack(_each(column)).T


def _triple(rows: Array, first: int) -> _Triple:
    return _each(lambda i: rows[:, first + i])


def _each(component: Callable[[int], Array]) -> _Triple:
    return component(0), component(1), component(2)


def _cross(u: _Triple, v: _Triple) -> _Triple:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
