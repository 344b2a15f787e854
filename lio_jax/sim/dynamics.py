"""How a body moves about its route: a car heaves, a hand swings with the gait, a drone banks."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.sim.worlds import Dynamics

CHANNELS = ("forward", "left", "up", "roll", "pitch", "yaw")
"""Channels of the sway: offsets (m) along heading, left and up, then turns (rad) about the body's axes."""


class Sway(eqx.Module):
    """Sums of sinusoids, one sum for each of ``CHANNELS``."""

    amplitude: Float[Array, "6 modes"]
    """Amplitude of each sinusoid, m (first three channels) or rad."""
    frequency: Float[Array, "6 modes"]
    """Frequency of each sinusoid, Hz."""
    phase: Float[Array, "6 modes"]
    """Phase of each sinusoid at time 0, rad."""

    def at(self, time: Float[Array, ""]) -> Float[Array, "6"]:
        """Return the six offsets at ``time`` s."""
        return jnp.sum(self.amplitude * jnp.sin(2 * jnp.pi * self.frequency * time + self.phase), axis=1)


@dataclass(frozen=True)
class Handling:
    """Accelerations that limit how fast a body follows its route."""

    lateral: float
    """Lateral acceleration in corners, m/s^2."""
    braking: float
    """Mean deceleration ahead of corners, m/s^2."""
    acceleration: float
    """Largest acceleration while pulling away, m/s^2."""
    climbs: bool
    """Whether the body pitches with the slope of its route."""


HANDLING: dict[Dynamics, Handling] = {
    "car": Handling(lateral=1.75, braking=1.1, acceleration=2.7, climbs=True),
    "handheld": Handling(lateral=1.0, braking=0.8, acceleration=1.5, climbs=False),
    "drone": Handling(lateral=2.5, braking=1.5, acceleration=2.5, climbs=False),
}

_GRAVITY = 9.80665
_CAR_ROLL = 0.008
"""Roll towards the outside of a bend, rad per m/s^2."""

_MODES: dict[Dynamics, dict[str, list[tuple[float, float]]]] = {
    "car": {
        "up": [(0.012, 1.4), (0.004, 2.3)],
        "roll": [(0.006, 0.9), (0.002, 2.1)],
        "pitch": [(0.005, 1.1), (0.002, 1.9)],
    },
    "handheld": {
        "left": [(0.02, 0.95)],
        "up": [(0.015, 1.9), (0.003, 3.8)],
        "roll": [(0.012, 0.95)],
        "pitch": [(0.01, 1.9)],
    },
    "drone": {
        "forward": [(3e-6, 61.0), (0.05, 0.17)],
        "left": [(3e-6, 73.0), (0.05, 0.23)],
        "up": [(6e-6, 47.0), (0.2, 0.11), (0.1, 0.07)],
        "roll": [(1e-4, 41.0), (0.02, 0.6)],
        "pitch": [(1e-4, 53.0), (0.02, 0.7)],
        "yaw": [(2e-5, 37.0), (0.1, 0.13)],
    },
}
"""Amplitude (m or rad) and frequency (Hz) of each channel's modes; a drone's rotors shake at tens of Hz."""

_LOOKING: dict[str, tuple[float, list[float]]] = {
    "yaw": (0.7, [0.31, 0.47]),
    "pitch": (0.5, [0.23, 0.41]),
    "roll": (0.4, [0.19, 0.37]),
}
"""Share of the swing rate, and frequencies (Hz) at 1 rad/s, with which a hand looks around."""


def sway(dynamics: Dynamics, swing_rate: float, seed: int) -> Sway:
    """Return a body's sway.

    Args:
        dynamics: what kind of body.
        swing_rate: bound on the angular rate with which a handheld body looks around, rad/s.
        seed: seed of the phases, and of a change of each frequency by up to 5 %.

    Returns:
        The sway, in float64 where JAX's x64 mode is on.
    """
    modes = {channel: list(_MODES[dynamics].get(channel, [])) for channel in CHANNELS}
    if dynamics == "handheld":
        # a faster swing is both wider and quicker
        quicker = np.sqrt(swing_rate)
        for channel, (share, frequencies) in _LOOKING.items():
            amplitudes = [share * quicker / (2 * np.pi * base * len(frequencies)) for base in frequencies]
            modes[channel] += zip(amplitudes, np.multiply(quicker, frequencies), strict=True)
    width = max(len(rows) for rows in modes.values())
    table = np.zeros((len(CHANNELS), width, 2))
    for row, channel in enumerate(CHANNELS):
        table[row, : len(modes[channel])] = np.reshape(modes[channel], (-1, 2))
    key = jax.random.fold_in(jax.random.key(seed), 4)
    draws = np.asarray(jax.random.uniform(key, (2, len(CHANNELS), width), jnp.float32), float)
    frequency = table[..., 1] * (0.95 + 0.1 * draws[0])
    return Sway(jnp.asarray(table[..., 0]), jnp.asarray(frequency), jnp.asarray(2 * np.pi * draws[1]))


def bank_angles(
    control: NDArray[np.float64], knot_rate: float, dynamics: Dynamics, closed: bool
) -> NDArray[np.float64]:
    """Return the roll (rad) at each control point of the path at full speed, smoothed over about 1 s."""
    if dynamics == "handheld":
        return np.zeros(len(control))
    before, after = (np.roll(control, shift, axis=0) for shift in (1, -1))
    velocity = (after - before)[:, :2] * knot_rate / 2
    acceleration = (after - 2 * control + before)[:, :2] * knot_rate**2
    left = (velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]) / np.linalg.norm(
        velocity, axis=1
    )
    if not closed:
        left[[0, -1]] = 0
    roll = _CAR_ROLL * left if dynamics == "car" else -np.arctan2(left, _GRAVITY)
    half = max(1, round(knot_rate / 2))
    window = np.hanning(2 * half + 3)[1:-1]
    padded = np.pad(roll, half, mode="wrap" if closed else "edge")
    return np.convolve(padded, window / window.sum(), mode="valid")
