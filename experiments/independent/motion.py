"""Motion of the IMU through the street by scipy's splines, which give the exact derivatives."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from independent.street import CentreLine, Floats, Ground, smooth_step

Kind = Literal["vehicle", "handheld"]
Start = Literal["rest", "moving"]

GRAVITY = np.array([0.0, 0.0, -9.80665])
"""Gravity in the world frame, m/s^2."""
REST_S = 1.5
"""Time at rest before the motion starts, s."""
_KNOT_S, _FINE_S = 0.05, 0.001
_HEIGHT_M = {"vehicle": 1.0, "handheld": 1.3}
"""Height of the IMU above the ground."""
_FIRST_ARC_M = {"vehicle": 0.0, "handheld": 56.0}
"""Place on the centre line where the motion starts: a walker reaches the bend, too."""
_SPEEDS = {
    "vehicle": ((0.0, 4.0, 8.0), (8.0, 3.0, -3.0), (15.0, 4.0, 4.0)),
    "handheld": ((0.0, 2.0, 1.4), (9.0, 2.0, -0.6), (15.0, 2.0, 0.8)),
}
"""Changes of the speed: time from the start of the motion (s), duration (s), change (m/s)."""


@dataclass(frozen=True)
class Motion:
    """T_world_imu over time: a quintic spline of the position and a cubic spline of the rotation."""

    position: BSpline
    rotation: RotationSpline
    at_rest_first: bool

    def poses(self, times: Floats) -> Floats:
        """Return (n, 4, 4) T_world_imu at times in s."""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = self.rotation(times).as_matrix()
        poses[:, :3, 3] = self.position(times)
        return poses

    def angular_rate(self, times: Floats) -> Floats:
        """Return (n, 3) rad/s in the IMU frame."""
        return np.asarray(self.rotation(times, 1))

    def specific_force(self, times: Floats) -> Floats:
        """Return (n, 3) m/s^2 in the IMU frame: R' (a - g)."""
        return self.rotation(times).inv().apply(self.position(times, 2) - GRAVITY)


def motion_of(
    kind: Kind, start: Start, seconds: float, seed: int, line: CentreLine, ground: Ground
) -> Motion:
    """Return a drive or a walk along the street.

    Args:
        kind: ``vehicle`` drives at 5 to 9 m/s, ``handheld`` walks at 0.8 to 1.6 m/s and shakes.
        start: ``rest`` stands still first, ``moving`` begins at the first speed.
        seconds: length of the recording, s.
        seed: seed of the shaking.
        line: the street's centre line.
        ground: height of the ground.
    """
    rng = np.random.default_rng([seed, 2])
    knots = np.arange(-4, round(seconds / _KNOT_S) + 5) * _KNOT_S
    first_change_s = _SPEEDS[kind][0][1]
    # a recording that begins in motion begins when the first speed is reached
    since = knots - REST_S if start == "rest" else knots + first_change_s
    arc = _FIRST_ARC_M[kind] + _way(kind, since)
    if start == "moving":
        arc -= _way(kind, np.array([since[0]]))
    # at rest nothing shakes
    activity = smooth_step(since / 1.5)[:, None]
    wave = _waves(rng, knots)
    heading = line.heading(arc)
    if kind == "vehicle":
        offset = activity * wave([0.01, 0.02, 0.01], 0.8, 1.6)
        turns = activity * wave([0.004, 0.006, 0.006], 0.7, 1.5)
    else:
        bob = np.stack([0 * knots, np.sin(2 * np.pi * 0.9 * knots), np.sin(2 * np.pi * 1.8 * knots)], axis=1)
        offset = activity * (0.03 * bob + wave([0.03, 0.03, 0.02], 0.6, 1.4))
        turns = activity * wave([0.12, 0.14, 0.16], 0.4, 1.1)
    plane = line.point(arc, offset[:, 1])
    height = ground.height(plane) + _HEIGHT_M[kind] + offset[:, 2]
    along = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    slope = ground.slope(plane)
    pitch, roll = -np.sum(slope * along, axis=1), np.sum(slope * left, axis=1)
    lying = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=1))
    shaken = lying * Rotation.from_rotvec(turns)
    return Motion(
        make_interp_spline(knots, np.column_stack([plane, height]), k=5),
        RotationSpline(knots, shaken),
        start == "rest",
    )


def _way(kind: Kind, since: Floats) -> Floats:
    """Return the way covered since the motion started, m; 0 before it."""
    fine = np.arange(0.0, max(float(since[-1]), _FINE_S) + _FINE_S, _FINE_S)
    speed = sum(change * smooth_step((fine - begins) / lasts) for begins, lasts, change in _SPEEDS[kind])
    way = np.concatenate([[0.0], np.cumsum(0.5 * _FINE_S * (speed[1:] + speed[:-1]))])
    return np.interp(since, fine, way)


def _waves(rng: np.random.Generator, times: Floats) -> Callable[[list[float], float, float], Floats]:
    """Return a function that draws sums of three sines for three axes."""

    def drawn(amplitude: list[float], lowest_hz: float, highest_hz: float) -> Floats:
        frequency = rng.uniform(lowest_hz, highest_hz, (3, 3))
        phase = rng.uniform(0, 2 * np.pi, (3, 3))
        waves = np.sin(2 * np.pi * frequency * times[:, None, None] + phase)
        return np.asarray(amplitude) * waves.mean(axis=1)

    return drawn
