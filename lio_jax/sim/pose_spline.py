"""A motion through given poses: quintic in position and in the quaternion, four times differentiable."""

import math

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import make_interp_spline

from lio_jax.core.errors import LioJaxError
from lio_jax.data.trajectory import Trajectory

_DEGREE = 5
_LARGEST_TURN = np.deg2rad(90)


class PoseSpline(eqx.Module):
    """Polynomials of degree 5 between time stamps.

    The quaternion is interpolated in its four numbers and normalised. Turning the world or the body acts on
    those numbers as a rotation of 4-space, under which interpolation is equivariant: no axis is preferred.
    """

    breaks: Float[Array, " n_plus_1"]
    """Where the polynomials meet, s from the first pose."""
    coefficients: Float[Array, "n 6 7"]
    """Descending powers of the time since the interval's start: quaternion wxyz, position x y z (m)."""
    duration: Float[Array, ""]
    """The motion is defined from 0 to this time, s."""

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
    """Fit the spline that meets every pose; to be called in JAX's x64 mode.

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
    # q and -q are one rotation: take the nearer one, all along
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
