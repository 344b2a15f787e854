"""The motion between two filter states at every instant, for deskewing."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int32

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.implicit import with_derivative_of
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


class _PerPoint(NamedTuple):
    """What moves each of n points: everything of its interval, its delay and its place in the body frame."""

    rows: Float[Array, "n 24"]
    """The interval's vectors."""
    delay: Float[Array, " n"]
    """Time since the interval's start, s."""
    gravity: Float[Array, "3"]
    """m/s^2."""
    points: Float[Array, "n 3"]
    """m, body frame."""


def _per_point(motion: _Motion, time: Float[Array, " n"], points: Float[Array, "n 3"]) -> _PerPoint:
    interval = _interval_at(motion.time, time)
    # a single gather of whole rows
    rows = motion.vectors.reshape(-1, 24)[interval]
    return _PerPoint(rows, time.astype(rows.dtype) - motion.time[interval], motion.gravity, points)


def _carried(motion: _Motion, time: Float[Array, " n"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return points, given in the body frame at their own times, in the motion's frame."""
    each = _per_point(motion, time, points)
    known = _placed(*jax.lax.stop_gradient(each))
    return with_derivative_of(known, _placed_slope, jax.lax.stop_gradient(each), each)


def _placed(
    rows: Float[Array, "n 24"], h: Float[Array, " n"], gravity: Float[Array, "3"], points: Float[Array, "n 3"]
) -> Float[Array, "n 3"]:
    return jnp.stack(_each(_place(_vectors(rows), h, gravity, _triple(points, 0)))).T


def _placed_slope(held: _PerPoint, each: _PerPoint) -> Float[Array, "n 3"]:
    """Return a linear function of what moves the points, whose slope is that of :func:`_placed` at ``held``.

    Three matrices and a velocity per point are worked out once for all tangents. Nothing but the angular rate
    and the delay enters in a nonlinear way.
    """
    vectors, gravity, points = _vectors(held.rows), held.gravity, _triple(held.points, 0)
    h = held.delay
    zero = jnp.zeros_like(h)
    one, nothing = jnp.ones_like(h), (zero, zero, zero)
    units = (one, zero, zero), (zero, one, zero), (zero, zero, one)

    def along(direction: tuple[_Triple, Array]) -> _Triple:
        def moved(rate: _Triple, delay: Array) -> _Triple:
            return _each(_place(vectors._replace(rate=rate), delay, gravity, points))

        return jax.jvp(moved, (vectors.rate, h), direction)[1]

    def turned(vector: _Triple, force: _Triple) -> _Triple:
        only = _Vectors(*((nothing,) * 3), vector, vectors.rate, force, nothing, nothing)
        return _each(_place(only, h, jnp.zeros_like(gravity), nothing))

    by_rate = [along((unit, zero)) for unit in units]
    by_delay = along((nothing, one))
    by_arm, by_force = [turned(unit, nothing) for unit in units], [turned(nothing, unit) for unit in units]
    by_rate, by_delay, by_arm, by_force = computed_once((by_rate, by_delay, by_arm, by_force))

    change = _vectors(each.rows - held.rows)
    longer = each.delay - h
    steeper = each.gravity - gravity
    further = _triple(each.points - held.points, 0)
    axes, held_axes = change[:3], vectors[:3]

    def arm(i: int) -> Array:
        spread = sum(x * axis[i] for x, axis in zip(points, axes, strict=True))
        return spread + sum(dx * axis[i] for dx, axis in zip(further, held_axes, strict=True)) + change.arm[i]

    moved_arm = _each(arm)

    def column(i: int) -> Array:
        fallen = change.position[i] + h * (change.velocity[i] + h / 2 * steeper[i]) + by_delay[i] * longer
        parts = (by_rate, change.rate), (by_force, change.force), (by_arm, moved_arm)
        return fallen + sum(by[m][i] * of[m] for by, of in parts for m in range(3))

    return jnp.stack(_each(column)).T


class _Vectors(NamedTuple):
    """The vectors of :class:`_Motion` at each of n points."""

    x_axis: _Triple
    y_axis: _Triple
    z_axis: _Triple
    arm: _Triple
    rate: _Triple
    force: _Triple
    position: _Triple
    velocity: _Triple


def _vectors(rows: Float[Array, "n 24"]) -> _Vectors:
    return _Vectors(*(_triple(rows, 3 * i) for i in range(8)))


def _place(
    vectors: _Vectors, h: Float[Array, " n"], gravity: Float[Array, "3"], points: _Triple
) -> Callable[[int], Array]:
    """Return points in the motion's frame, component by component.

    With w = h rate the rotated point is p + a w x p + b w x (w x p), where p and the rate are in the axes of
    the motion. The second integral of the rotating specific force has the same form.
    """
    x_axis, y_axis, z_axis, arm, rate, force, position, velocity = vectors
    x, y, z = points
    p = _each(lambda i: x * x_axis[i] + y * y_axis[i] + z * z_axis[i] + arm[i])
    w = _each(lambda i: h * rate[i])
    # computed once, and not for each column again
    a, b, c, d = computed_once(rotation_series(jnp.minimum(sum(x**2 for x in w), SERIES_LIMIT)))
    turned, pushed = _cross(w, p), _cross(w, force)
    twice, pushed_twice = _cross(w, turned), _cross(w, pushed)

    def column(i: int) -> Array:
        fallen = position[i] + h * (velocity[i] + h / 2 * gravity[i])
        driven = h**2 * (force[i] / 2 + c * pushed[i] + d * pushed_twice[i])
        return fallen + driven + p[i] + a * turned[i] + b * twice[i]

    return column


def _triple(rows: Array, first: int) -> _Triple:
    return _each(lambda i: rows[:, first + i])


def _each(component: Callable[[int], Array]) -> _Triple:
    return component(0), component(1), component(2)


def _cross(u: _Triple, v: _Triple) -> _Triple:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
