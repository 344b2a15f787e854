"""Smooth motion along a route or through given poses."""

import math
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_interp_spline

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.dynamics import HANDLING, Sway, bank_angles, sway
from lio_jax.sim.route_smoothing import timed_path
from lio_jax.sim.worlds import Route

SWING_RATE = 0.8
"""Default of how fast a hand looks around, rad/s."""
_DEGREE = 5
_LARGEST_TURN = np.deg2rad(90)


class PoseSpline(eqx.Module):
    """Polynomials of degree 5 between time stamps.

    The spline interpolates the quaternion's four numbers and then normalises them. A rotation of the world or
    of the body acts on those numbers as a rotation of 4-space. Interpolation is equivariant under it: no axis
    is preferred.
    """

    breaks: Float[Array, " n_plus_1"]
    """Times at which the polynomials meet, s from the first pose."""
    coefficients: Float[Array, "n 6 7"]
    """Coefficients of descending powers of the time since the interval's start: quaternion wxyz, xyz (m)."""
    duration: Float[Array, ""]
    """End of the motion, which is defined from 0 to this time, s."""

    def pose(self, time: Float[Array, ""]) -> jaxlie.SE3:
        """Return T_world_imu at ``time`` s from the first pose."""
        last = self.coefficients.shape[0] - 1
        index = jnp.clip(jnp.searchsorted(self.breaks, time, side="right") - 1, 0, last)
        elapsed = time - self.breaks[index]
        rows = self.coefficients[index]
        value = rows[0]
        for row in rows[1:]:
            value = value * elapsed + row
        quaternion = value[:4] / jnp.sqrt(jnp.sum(value[:4] ** 2))
        return jaxlie.SE3(jnp.concatenate([quaternion, value[4:]]))


def spline_through(trajectory: Trajectory) -> PoseSpline:
    """Fit the spline that meets every pose; call it in JAX's x64 mode.

    Raises:
        LioJaxError: fewer than six poses, time that does not ascend, numbers that are not finite, or a turn
            of more than 90 degrees from one pose to the next.
    """
    count = len(trajectory)
    if count < _DEGREE + 1:
        raise LioJaxError(f"trajectory: {count} poses; a smooth motion needs at least {_DEGREE + 1}.")
    if np.any(np.diff(trajectory.stamp_ns) <= 0):
        index = int(np.argmax(np.diff(trajectory.stamp_ns) <= 0)) + 1
        raise LioJaxError(f"trajectory: time does not ascend at pose {index}; sort it and remove duplicates.")
    if not np.all(np.isfinite(trajectory.poses)):
        index = int(np.argmin(np.isfinite(trajectory.poses).all(axis=(1, 2))))
        raise LioJaxError(f"trajectory: pose {index} holds numbers that are not finite; remove it.")
    wxyz = trajectory.quaternions[:, [3, 0, 1, 2]]
    # q and -q are the same rotation: each quaternion takes the sign nearest to the one before
    signs = np.where(np.sum(wxyz[1:] * wxyz[:-1], axis=1) < 0, -1.0, 1.0)
    wxyz = wxyz * np.concatenate([[1.0], np.cumprod(signs)])[:, None]
    turn = 2 * np.arccos(np.clip(np.sum(wxyz[1:] * wxyz[:-1], axis=1), -1, 1))
    if turn.max() > _LARGEST_TURN:
        index = int(np.argmax(turn)) + 1
        raise LioJaxError(
            f"trajectory: pose {index} is turned by {np.rad2deg(turn[index - 1]):.0f} degrees from the one "
            "before; give poses at most 90 degrees apart."
        )
    times = (trajectory.stamp_ns - trajectory.stamp_ns[0]) * 1e-9
    spline = make_interp_spline(times, np.column_stack([wxyz, trajectory.positions]), k=_DEGREE)
    breaks = np.unique(spline.t)
    powers = range(_DEGREE, -1, -1)
    taylor = [spline(breaks[:-1], nu=order) / math.factorial(order) for order in powers]
    return PoseSpline(jnp.asarray(breaks), jnp.asarray(np.stack(taylor, axis=1)), jnp.asarray(times[-1]))


_SMOOTHSTEP_PEAK = 35 / 16
"""Largest slope of the smoothstep function."""

_QUINTIC = (
    np.array(
        [
            [1, -5, 10, -10, 5, -1],
            [26, -50, 20, 20, -20, 5],
            [66, 0, -60, 0, 30, -10],
            [26, 50, 20, -20, -20, 10],
            [1, 5, 10, 10, 5, -5],
            [0, 0, 0, 0, 0, 1],
        ]
    )
    / 120
)
"""Uniform quintic B-spline: a control point's weight in each row, ascending powers of the knot's fraction."""


class RouteMotion(eqx.Module):
    """Motion along a route: first at rest, then moving; lap after lap, or to the end and back."""

    control: Float[Array, "n 4"]
    """Control points x, y, z (world frame, m) and roll at full speed (rad); their spacing sets the speed."""
    sway: Sway
    """Sway that is added to the path once the body moves."""
    knot_rate: Float[Array, ""]
    """Number of control points passed in a second at full speed."""
    standstill: Float[Array, ""]
    """Time at which the body starts to move, s; negative: it started before time 0."""
    pull_away: Float[Array, ""]
    """Time from rest to full speed, s."""
    climb: Float[Array, ""]
    """1 where the body pitches with the slope of its path, 0 where it stays level."""
    duration: Float[Array, ""]
    """Intended length of the motion, from 0 to this time, s; the motion itself has no end."""
    closed: bool = eqx.field(static=True)
    """Whether the path is a loop."""

    def pose(self, time: Float[Array, ""]) -> jaxlie.SE3:
        """Return T_world_imu at ``time`` s; body x forward, y left, z up."""
        knots, pace, moving = self._progress(time)
        place, tangent = self._path(knots)
        yaw = jnp.arctan2(tangent[1], tangent[0])
        slope = jnp.arctan2(tangent[2], jnp.sqrt(tangent[0] ** 2 + tangent[1] ** 2))
        forward, left, up, roll, pitch, turn = moving * self.sway.at(time - self.standstill)
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        offset = jnp.stack([cos * forward - sin * left, sin * forward + cos * left, up])
        quaternion = _yaw_pitch_roll(yaw + turn, pitch - self.climb * slope, roll + pace**2 * place[3])
        return jaxlie.SE3(jnp.concatenate([quaternion, place[:3] + offset]))

    def _progress(self, time: Float[Array, ""]) -> tuple[Array, Array, Array]:
        """Return the knots passed, the share of full speed, and the share of the start-up that is done."""
        elapsed = (time - self.standstill) / self.pull_away
        per_unit = self.knot_rate * self.pull_away
        moving = _smoothstep(elapsed)
        if self.closed:
            return per_unit * _smoothstep_integral(elapsed), moving, moving
        # there and back, with a stop at both ends; on a short route the body never reaches full speed
        cruise = (self.control.shape[0] - 6) / per_unit
        way = cruise + 1
        phase = jnp.mod(jnp.maximum(elapsed, 0), 2 * way)
        folded = jnp.where(phase < way, phase, 2 * way - phase)
        passed = _smoothstep_integral(folded) - _smoothstep_integral(folded - cruise)
        return per_unit * passed, _smoothstep(folded) - _smoothstep(folded - cruise), moving

    def _path(self, knots: Float[Array, ""]) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
        """Return the spline's value and its slope per knot."""
        count = self.control.shape[0]
        if self.closed:
            first = jnp.floor(knots)
            index = (first.astype(jnp.int32) + jnp.arange(-2, 4)) % count
        else:
            first = jnp.clip(jnp.floor(knots), 0, count - 6)
            index = first.astype(jnp.int32) + jnp.arange(6)
        fraction = knots - first
        # Horner's scheme with static coefficients: a traced power has no derivative at 0
        coefficients = self.control[index].T @ jnp.asarray(_QUINTIC, self.control.dtype)
        value, slope = coefficients[:, 5], 5 * coefficients[:, 5]
        for order in range(4, -1, -1):
            value = value * fraction + coefficients[:, order]
            if order > 0:
                slope = slope * fraction + order * coefficients[:, order]
        return value, slope


Motion: TypeAlias = RouteMotion | PoseSpline
"""A motion: it has a ``duration`` and a pose for every instant."""


class Kinematics(eqx.Module):
    """The body's state at an instant."""

    T_world_imu: jaxlie.SE3
    velocity: Float[Array, "3"]
    """Velocity of the IMU origin, world frame, m/s."""
    acceleration: Float[Array, "3"]
    """Acceleration of the IMU origin without gravity, world frame, m/s^2."""
    angular_velocity: Float[Array, "3"]
    """Angular velocity of the body, IMU frame, rad/s."""


def pose_at(motion: Motion, time: Float[Array, ""]) -> jaxlie.SE3:
    """Return T_world_imu at ``time`` s from the motion's start."""
    return motion.pose(time)


def kinematics_at(motion: Motion, time: Float[Array, ""]) -> Kinematics:
    """Return pose, velocity, acceleration and angular velocity at ``time`` s, exactly."""
    one = jnp.ones_like(time)

    def moving(instant: Float[Array, ""]) -> tuple[Float[Array, "7"], Float[Array, "7"]]:
        return jax.jvp(lambda t: pose_at(motion, t).wxyz_xyz, (instant,), (one,))

    (value, rate), (_, second) = jax.jvp(moving, (time,), (one,))
    # for the unit quaternion q: omega = 2 q* dq/dt
    turning = jaxlie.SO3(value[:4]).inverse().wxyz
    angular = 2 * jaxlie.SO3(turning).multiply(jaxlie.SO3(rate[:4])).wxyz[1:]
    return Kinematics(jaxlie.SE3(value), rate[4:], second[4:], angular)


def motion_along(
    route: Route,
    *,
    duration_s: float,
    standstill_s: float = 0.0,
    moving_start: bool = False,
    seed: int = 0,
    swing_rate: float = SWING_RATE,
) -> RouteMotion:
    """Return the motion of a body along a route.

    Args:
        route: the path, the speed and the kind of body.
        duration_s: length of the recording, s.
        standstill_s: time at rest before the body moves off, s.
        moving_start: whether the body already moves at full speed at time 0, after a start before time 0.
        seed: seed of the sway.
        swing_rate: how fast a handheld body looks around, rad/s; 4 is as fast as a wrist can.

    Returns:
        The motion in float64, in every mode of JAX.

    Raises:
        UsageError: an impossible duration, standstill or swing rate, or a route that cannot be followed.
    """
    if not duration_s > 0:
        raise UsageError(f"a duration of {duration_s} s holds nothing; give more than 0 s.")
    if not standstill_s >= 0:
        raise UsageError(f"a standstill of {standstill_s} s is impossible; give 0 s or more.")
    if moving_start and standstill_s > 0:
        raise UsageError(
            f"a standstill of {standstill_s} s contradicts a moving start; choose one of the two."
        )
    if not 0 <= swing_rate <= 10:
        raise UsageError(f"a swing rate of {swing_rate} rad/s is impossible; give 0 to 10 rad/s.")
    handling = HANDLING[route.dynamics]
    control, knot_rate = timed_path(route, handling.lateral, handling.braking)
    roll = bank_angles(control, knot_rate, route.dynamics, route.closed)
    pull_away = _SMOOTHSTEP_PEAK * route.speed / handling.acceleration
    with jax.enable_x64(True):
        return RouteMotion(
            control=jnp.asarray(np.column_stack([control, roll])),
            sway=sway(route.dynamics, swing_rate, seed),
            knot_rate=jnp.float64(knot_rate),
            standstill=jnp.float64(-pull_away if moving_start else standstill_s),
            pull_away=jnp.float64(pull_away),
            climb=jnp.float64(handling.climbs),
            duration=jnp.float64(duration_s),
            closed=route.closed,
        )


def motion_through(trajectory: Trajectory) -> PoseSpline:
    """Return the smooth motion that meets every pose of a trajectory; time 0 is its first stamp.

    Returns:
        The motion in float64, in every mode of JAX.

    Raises:
        LioJaxError: the poses cannot be joined smoothly (see :func:`spline_through`).
    """
    with jax.enable_x64(True):
        return spline_through(trajectory)


def _yaw_pitch_roll(
    yaw: Float[Array, ""], pitch: Float[Array, ""], roll: Float[Array, ""]
) -> Float[Array, "4"]:
    """Return the quaternion wxyz of Rz(yaw) Ry(pitch) Rx(roll), written out to keep its derivatives short."""
    angles = jnp.stack([roll, pitch, yaw]) / 2
    (cx, cy, cz), (sx, sy, sz) = jnp.cos(angles), jnp.sin(angles)
    return jnp.stack(
        [
            cz * cy * cx + sz * sy * sx,
            cz * cy * sx - sz * sy * cx,
            cz * sy * cx + sz * cy * sx,
            sz * cy * cx - cz * sy * sx,
        ]
    )


def _smoothstep(x: Float[Array, ""]) -> Float[Array, ""]:
    x = jnp.clip(x, 0, 1)
    return x**4 * (35 + x * (-84 + x * (70 - 20 * x)))


def _smoothstep_integral(x: Float[Array, ""]) -> Float[Array, ""]:
    # from 0 to 1 the polynomial's integral, which ends at 1/2; then slope 1
    ramp = jnp.clip(x, 0, 1)
    return ramp**5 * (7 + ramp * (-14 + ramp * (10 - 2.5 * ramp))) + jnp.maximum(x - 1, 0)
