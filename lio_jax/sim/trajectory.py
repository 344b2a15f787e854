"""A car-like drive on a closed quintic B-spline: closed form, four times continuously differentiable in time.

Every derivative (velocity, acceleration, body rates) follows by ``jax.jvp`` of :func:`pose_at`.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray


class Drive(eqx.Module):
    """A lap on a closed path: standing first, then pulling away, then lap after lap."""

    control: Float[Array, "n 2"]
    """Control points of the closed path, world frame, m; their spacing sets the speed."""
    knot_rate: Float[Array, ""]
    """Control points passed per second at full speed."""
    standstill: Float[Array, ""]
    """Time at rest before pulling away, s."""
    pull_away: Float[Array, ""]
    """Time from rest to full speed, s."""
    sway: Float[Array, "3 2"]
    """Amplitude and frequency (Hz) of the body's heave (m), roll (rad) and pitch (rad) at full speed."""


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
"""Uniform quintic B-spline: a control point's weight per row, ascending powers of the knot's fraction."""


def pose_at(drive: Drive, time: Float[Array, ""]) -> jaxlie.SE3:
    """Return T_world_body at ``time`` s from the drive's start; body x forward, y left, z up."""
    elapsed = (time - drive.standstill) / drive.pull_away
    knots = drive.knot_rate * drive.pull_away * _smoothstep_integral(elapsed)
    position, tangent = _spline(drive.control, knots)
    amplitude, frequency = drive.sway.T
    phase = 2 * jnp.pi * frequency * (time - drive.standstill)
    heave, roll, pitch = amplitude * jnp.sin(phase) * _smoothstep(elapsed)
    rotation = (
        jaxlie.SO3.from_z_radians(jnp.arctan2(tangent[1], tangent[0]))
        @ jaxlie.SO3.from_y_radians(pitch)
        @ jaxlie.SO3.from_x_radians(roll)
    )
    return jaxlie.SE3.from_rotation_and_translation(rotation, jnp.append(position, heave))


def _spline(
    control: Float[Array, "n 2"], knots: Float[Array, ""]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    first = jnp.floor(knots)
    fraction = knots - first
    rows = control[(first.astype(jnp.int32) + jnp.arange(-2, 4)) % control.shape[0]]
    # Horner on static coefficients: a traced power has no derivative at 0
    coefficients = rows.T @ jnp.asarray(_QUINTIC, control.dtype)
    position, tangent = coefficients[:, 5], 5 * coefficients[:, 5]
    for order in range(4, -1, -1):
        position = position * fraction + coefficients[:, order]
        if order > 0:
            tangent = tangent * fraction + order * coefficients[:, order]
    return position, tangent


def _smoothstep(x: Float[Array, ""]) -> Float[Array, ""]:
    x = jnp.clip(x, 0, 1)
    return x**4 * (35 + x * (-84 + x * (70 - 20 * x)))


def _smoothstep_integral(x: Float[Array, ""]) -> Float[Array, ""]:
    # from 0 to 1 the polynomial's integral, 1/2 at the end; then the full rate
    ramp = jnp.clip(x, 0, 1)
    return ramp**5 * (7 + ramp * (-14 + ramp * (10 - 2.5 * ramp))) + jnp.maximum(x - 1, 0)


def rounded_lap(
    corners: NDArray[np.float64],
    radius: float,
    start: NDArray[np.float64],
    spacing: float,
    corner_spacing: float,
) -> NDArray[np.float64]:
    """Return the control points of a closed path along ``corners`` with rounded turns.

    Args:
        corners: (m, 2) vertices in driving order, m.
        radius: of the turns, m.
        start: (2,) point of the path where the lap begins, m.
        spacing: of the control points on straights, m.
        corner_spacing: of the control points in turns, m: smaller is slower.

    Returns:
        (n, 2) m; n follows from the spacings, which are scaled a little to close the lap.
    """
    path, turning = _rounded_polygon(corners, radius)
    first = int(np.argmin(np.linalg.norm(path - start, axis=1)))
    path, turning = np.roll(path, -first, axis=0), np.roll(turning, -first)
    steps = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1)
    # slow down ahead of a turn: spread the turn's spacing over about 10 m to both sides
    width = max(1, int(10 / steps.mean()))
    window = np.hanning(2 * width + 1)
    padded = np.concatenate([turning[-width:], turning, turning[:width]]).astype(float)
    slow = np.minimum(2 * np.convolve(padded, window / window.sum(), mode="valid"), 1)
    density = 1 / (spacing + (corner_spacing - spacing) * slow)
    passed = np.concatenate([[0], np.cumsum(steps * density)])
    count = round(passed[-1])
    wanted = np.arange(count) * passed[-1] / count
    closed = np.vstack([path, path[:1]])
    return np.stack([np.interp(wanted, passed, closed[:, axis]) for axis in range(2)], axis=1)


def _rounded_polygon(
    corners: NDArray[np.float64], radius: float, step: float = 0.05
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    path: list[NDArray[np.float64]] = []
    turning: list[NDArray[np.bool_]] = []
    for before, corner, after in zip(
        np.roll(corners, 1, axis=0), corners, np.roll(corners, -1, axis=0), strict=True
    ):
        arrive, leave = _unit(corner - before), _unit(after - corner)
        turn = np.arctan2(arrive[0] * leave[1] - arrive[1] * leave[0], arrive @ leave)
        cut = radius * np.tan(abs(turn) / 2)
        previous = path[-1][-1] if path else None
        entry = corner - cut * arrive
        if previous is not None:
            path.append(_line(previous, entry, step))
            turning.append(np.zeros(len(path[-1]), bool))
        angles = np.linspace(0, turn, max(2, int(radius * abs(turn) / step)))
        side = np.sign(turn) * np.array([-arrive[1], arrive[0]])
        center = entry + radius * side
        arc = center - radius * (np.cos(angles)[:, None] * side - np.sin(np.abs(angles))[:, None] * arrive)
        path.append(arc)
        turning.append(np.ones(len(arc), bool))
    path.append(_line(path[-1][-1], path[0][0], step))
    turning.append(np.zeros(len(path[-1]), bool))
    return np.concatenate(path), np.concatenate(turning)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)


def _line(start: NDArray[np.float64], end: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    count = max(2, int(np.linalg.norm(end - start) / step))
    return start + np.linspace(0, 1, count, endpoint=False)[1:, None] * (end - start)
