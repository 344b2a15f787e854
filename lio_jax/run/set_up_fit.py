"""Which extrinsic and clock would explain best how the scans moved, given the inertial samples.

The lidar's poses in the middles of the sweeps are the measurements. Within a window of scans the gyroscope's
integral has to repeat the turns, and the twice integrated specific force the positions, up to a first
position and velocity, which are eliminated. Extrinsic, clock, biases and gravity enter linearly. So each
window adds to two small systems of normal equations, of turns and of positions, and the covariance shows what
the motion determines.

With P = T_imu_lidar's rotation transposed, lidar rotation R, position p, lever arm u in lidar axes, rate w
and force f: the turns are the integral of P (w - b_w), and
p(t) = p0 + v0 t + g t^2 / 2 + double integral of R P (f - b_f) + R u.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_TURN, _GYRO_BIAS, _CLOCK = slice(0, 3), slice(3, 6), 6
_ACCEL_BIAS, _GRAVITY, _ARM = slice(7, 10), slice(10, 13), slice(13, 16)
_SIZE = 16
_PRIOR_SIGMA = np.repeat([3.0, 0.05, 0.5, 0.3, 5.0, 3.0], [3, 3, 1, 3, 3, 3])
"""What is known beforehand, in the order of the parameters: a turn of the extrinsic (rad), the gyroscope's
bias (rad/s), the clock (s), the accelerometer's bias (m/s^2), gravity (m/s^2) and the lever arm (m). The
accelerometer's bias alone is known to any use: on level ground it looks like a tilt of the extrinsic."""
SOUGHT = {"rotation": np.r_[0:3], "translation": np.r_[13:16], "clock": np.r_[6:7]}
"""The parameters of the set-up by name."""
_NUISANCE = np.r_[3:6, 7:13]
"""Biases and gravity, which differ from run to run."""
_ROUNDS = 6
"""Number of solutions, after each of which a window's residuals tell its noise."""
_LEAST_TURN_SIGMA, _LEAST_POSITION_SIGMA = 1e-4, 1e-3
"""Smallest standard deviations of the scans' attitudes (rad) and positions (m) that are believed."""
_STEP_S = 0.005
"""Shift of the clock by which its derivative is taken, s."""
_LONGEST_STEP = 0.5
"""Largest turn of the extrinsic in one iteration, rad."""


class Samples(NamedTuple):
    """Inertial samples, in ascending time."""

    seconds: Array
    """(n,) s since the run's origin, on the IMU's clock."""
    gyro: Array
    accel: Array


class Poses(NamedTuple):
    """The lidar's poses of consecutive scans, in the middles of their sweeps."""

    seconds: Array
    """(n,) s since the run's origin, on the lidar's clock."""
    rotations: Array
    """(n, 3, 3) R_world_lidar."""
    positions: Array
    """(n, 3) m in world."""


@dataclass(frozen=True)
class SetUp:
    """How the IMU sits by the lidar, and its constant errors."""

    R_imu_lidar: Rotation
    t_imu_lidar: Array
    """(3,) m, IMU frame."""
    time_offset: float = 0.0
    """A scan stamped t was taken at IMU time t + time_offset, s."""
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) rad/s, lidar axes."""
    accel_bias: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) m/s^2, lidar axes."""
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    """(3,) m/s^2, world."""

    def stepped(self, step: Array) -> "SetUp":
        """Return the set-up after a step of the parameters."""
        length = float(np.linalg.norm(step[_TURN]))
        turn = Rotation.from_rotvec(step[_TURN] * min(1.0, _LONGEST_STEP / max(length, 1e-12)))
        to_lidar = turn * self.R_imu_lidar.inv()
        arm = self.R_imu_lidar.inv().apply(self.t_imu_lidar) + step[_ARM]
        return SetUp(
            R_imu_lidar=to_lidar.inv(),
            t_imu_lidar=to_lidar.inv().apply(arm),
            time_offset=self.time_offset + float(step[_CLOCK]),
            gyro_bias=turn.apply(self.gyro_bias) + step[_GYRO_BIAS],
            accel_bias=turn.apply(self.accel_bias) + step[_ACCEL_BIAS],
            gravity=self.gravity + step[_GRAVITY],
        )


class Normal(NamedTuple):
    """Normal equations of one kind of measurement."""

    matrix: Array
    """(16, 16)."""
    vector: Array
    """(16,)."""
    squared: float
    """Sum of the squared residuals."""
    freedom: int
    """Number of residuals beyond those that the window's own parameters absorb."""

    @staticmethod
    def of(jacobian: Array, residual: Array, absorbed: Array) -> "Normal":
        """Return the equations of (n, 3) residuals after the columns ``absorbed`` (n, k) are eliminated.

        Args:
            jacobian: (n, 3, 16).
            residual: (n, 3).
            absorbed: orthonormal functions of the time, one parameter for each axis.
        """
        jacobian = jacobian - np.tensordot(absorbed, np.tensordot(absorbed.T, jacobian, 1), 1)
        residual = residual - absorbed @ (absorbed.T @ residual)
        rows = jacobian.reshape(-1, _SIZE)
        freedom = 3 * (len(residual) - absorbed.shape[1])
        return Normal(rows.T @ rows, rows.T @ residual.ravel(), float(np.sum(residual**2)), freedom)

    def after(self, step: Array) -> float:
        """Return the sum of the squared residuals after a step."""
        return max(float(self.squared - 2 * step @ self.vector + step @ self.matrix @ step), 0.0)


class Equations(NamedTuple):
    """What a window of scans says about the parameters."""

    turns: Normal
    positions: Normal
    turning: float
    """Sum of the squared turns themselves, about their mean, rad^2."""


class Fit(NamedTuple):
    """The solution of the windows' equations."""

    step: Array
    """(16,) the change of the parameters."""
    covariance: Array
    turn_sigma: float
    """Root mean square of what remains of the turns in the median window, rad."""
    position_sigma: float
    """Root mean square of what remains of the positions in the median window, m."""
    gain: float
    """Squared residuals with the assumed set-up, over those with the fitted one."""
    turning: float
    """Root mean square of the turns themselves, about each window's mean, rad."""
    turn_left: float
    """Root mean square of what remains of them in all windows, rad."""
    cost: float
    """Logarithm of the residuals' likelihood, with the other sign: the best hypothesis has the smallest."""


def equations(poses: Poses, samples: Samples, set_up: SetUp) -> Equations | None:
    """Return the equations of a window, linearised at a set-up; None where samples are missing.

    Args:
        poses: at least four.
        samples: of the whole window and the time around it.
        set_up: where to linearise.
    """
    seconds = poses.seconds
    knots = _knots(samples, seconds, set_up.time_offset)
    if knots is None:
        return None
    time, rate, force, force_change = knots
    to_lidar = set_up.R_imu_lidar.inv()
    rate = to_lidar.apply(rate) - set_up.gyro_bias
    force = to_lidar.apply(force)
    angle = _integral(time, rate)
    angle_at = _at(seconds, time, angle)
    turned = (
        Rotation.from_matrix(poses.rotations[:-1]).inv() * Rotation.from_matrix(poses.rotations[1:])
    ).as_rotvec()
    elapsed = seconds - seconds[0]

    jacobian = np.zeros((len(seconds), 3, _SIZE))
    jacobian[:, :, _TURN] = -_cross(angle_at)
    jacobian[:, :, _GYRO_BIAS] = -elapsed[:, None, None] * np.eye(3)
    jacobian[:, :, _CLOCK] = _at(seconds, time, rate)
    seen = np.concatenate([np.zeros((1, 3)), np.cumsum(turned, axis=0)])
    constant = np.full((len(seconds), 1), len(seconds) ** -0.5)
    turns = Normal.of(jacobian, seen - angle_at, constant)

    R = _attitudes(poses, time, angle, angle_at, turned)
    twice = [
        _integral(time, _integral(time, values))
        for values in (
            np.einsum("nij,nj->ni", R, force - set_up.accel_bias),
            np.einsum("nij,nj->ni", R, to_lidar.apply(force_change)),
            R,
            np.einsum("nij,njk->nik", R, _cross(force)),
        )
    ]
    fallen, by_clock, by_bias, by_turn = (_at(seconds, time, values) for values in twice)
    by_gravity = 0.5 * elapsed[:, None, None] ** 2 * np.eye(3)
    arm = to_lidar.apply(set_up.t_imu_lidar)
    jacobian = np.zeros((len(seconds), 3, _SIZE))
    jacobian[:, :, _TURN] = -by_turn
    jacobian[:, :, _CLOCK] = by_clock
    jacobian[:, :, _ACCEL_BIAS] = -by_bias
    jacobian[:, :, _GRAVITY] = by_gravity
    jacobian[:, :, _ARM] = poses.rotations
    residual = poses.positions - by_gravity @ set_up.gravity - fallen - poses.rotations @ arm
    line, _ = np.linalg.qr(np.stack([np.ones_like(elapsed), elapsed], axis=1))
    turning = float(np.sum((seen - seen.mean(axis=0)) ** 2))
    return Equations(turns, Normal.of(jacobian, residual, line), turning)


def solved(windows: Sequence[Equations], at: SetUp, sought: Sequence[str] = tuple(SOUGHT)) -> Fit:
    """Return the most likely step of the parameters; each window's residuals tell its noise.

    A window in which the scans were matched badly thereby loses its weight.

    Args:
        windows: all linearised at ``at``.
        at: its biases count against what is known of them beforehand.
        sought: which of "rotation", "translation" and "clock" may change; biases and gravity always may.
    """
    prior = _PRIOR_SIGMA**-2
    known = np.zeros(_SIZE)
    known[_GYRO_BIAS], known[_ACCEL_BIAS] = at.gyro_bias, at.accel_bias
    free = np.concatenate([_NUISANCE, *(SOUGHT[name] for name in sought)])
    parts = [part for window in windows for part in (window.turns, window.positions)]
    matrices, vectors = np.array([part.matrix for part in parts]), np.array([part.vector for part in parts])
    freedom = np.array([part.freedom for part in parts])
    least = np.tile([_LEAST_TURN_SIGMA, _LEAST_POSITION_SIGMA], len(windows))
    sigmas = np.tile([2e-3, 1e-2], len(windows))

    def solution(weights: Array, free: NDArray[np.intp]) -> tuple[Array, Array]:
        matrix = (np.tensordot(weights, matrices, 1) + np.diag(prior))[np.ix_(free, free)]
        step = np.zeros(_SIZE)
        step[free] = np.linalg.solve(matrix, (weights @ vectors - prior * known)[free])
        return step, matrix

    for _ in range(_ROUNDS):
        weights = sigmas**-2
        step, matrix = solution(weights, free)
        squared = np.array([part.after(step) for part in parts])
        sigmas = np.maximum(np.sqrt(squared / freedom), least)
    assumed, _ = solution(weights, _NUISANCE)
    before = np.array([part.after(assumed) for part in parts])
    covariance = np.zeros((_SIZE, _SIZE))
    covariance[np.ix_(free, free)] = np.linalg.inv(matrix)
    turn_sigma, position_sigma = np.median(sigmas.reshape(-1, 2), axis=0).tolist()
    turns = freedom[::2].sum()
    return Fit(
        step=step,
        covariance=covariance,
        turn_sigma=turn_sigma,
        position_sigma=position_sigma,
        gain=float(weights @ before / (weights @ squared)),
        turning=float(np.sqrt(sum(window.turning for window in windows) / turns)),
        turn_left=float(np.sqrt(squared[::2].sum() / turns)),
        cost=float(freedom @ np.log(sigmas)),
    )


def fitted(
    windows: Sequence[Poses],
    samples: Samples,
    start: SetUp,
    iterations: int,
    sought: Sequence[str] = tuple(SOUGHT),
) -> tuple[SetUp, Fit] | None:
    """Return the set-up that explains the windows best, and the last solution; None: samples are missing.

    Args:
        windows: scans.
        samples: of the recording.
        start: where to begin.
        iterations: number of linearisations.
        sought: see :func:`solved`.
    """
    set_up, fit, gain = start, None, 1.0
    for _ in range(iterations):
        rows = [one for one in (equations(window, samples, set_up) for window in windows) if one is not None]
        if not rows:
            return None
        fit = solved(rows, set_up, sought)
        set_up, gain = set_up.stepped(fit.step), max(gain, fit.gain)
    assert fit is not None
    # near the solution the last step gains nothing
    return set_up, fit._replace(gain=gain)


def _knots(samples: Samples, seconds: Array, time_offset: float) -> tuple[Array, Array, Array, Array] | None:
    """Return times on the lidar's clock, rates, forces and the forces' derivative by the clock; IMU axes."""
    time = samples.seconds - time_offset
    first, last = np.searchsorted(time, [seconds[0] - _STEP_S, seconds[-1] + _STEP_S])
    if first == 0 or last == len(time):
        return None
    part = slice(int(first) - 1, int(last) + 1)
    time, gyro, accel = time[part], samples.gyro[part], samples.accel[part]
    if np.diff(time).max() > _LONGEST_GAP_S:
        return None
    within = time[(time > seconds[0]) & (time < seconds[-1])]
    at = np.concatenate([seconds[:1], within, seconds[-1:]])
    change = (_at(at + _STEP_S, time, accel) - _at(at - _STEP_S, time, accel)) / (2 * _STEP_S)
    return at, _at(at, time, gyro), _at(at, time, accel), change


_LONGEST_GAP_S = 0.03
"""Longest time between two samples of a window, s: slower samples do not follow the motion."""


def _attitudes(poses: Poses, time: Array, angle: Array, angle_at: Array, turned: Array) -> Array:
    """Return R_world_lidar at times: along the gyroscope's integral, from each scan's own to the next's."""
    last = len(poses.seconds) - 1
    scan = np.clip(np.searchsorted(poses.seconds, time, "right") - 1, 0, last)
    misfit = np.concatenate([turned - np.diff(angle_at, axis=0), np.zeros((1, 3))])
    length = np.append(np.diff(poses.seconds), 1.0)
    share = (time - poses.seconds[scan]) / length[scan]
    since = angle - angle_at[scan] + share[:, None] * misfit[scan]
    attitudes: Array = poses.rotations[scan] @ Rotation.from_rotvec(since).as_matrix()
    return attitudes


def _integral(time: Array, values: Array) -> Array:
    """Return the integral since the first time, by the trapezoidal rule along the first axis."""
    step = np.diff(time).reshape(-1, *[1] * (values.ndim - 1)) / 2
    total: Array = np.zeros_like(values)
    np.cumsum(step * (values[1:] + values[:-1]), axis=0, out=total[1:])
    return total


def _at(wanted: Array, time: Array, values: Array) -> Array:
    """Return values interpolated linearly along the first axis."""
    place = np.clip(np.searchsorted(time, wanted) - 1, 0, len(time) - 2)
    share = (wanted - time[place]) / (time[place + 1] - time[place])
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    result: Array = values[place] * (1 - share) + values[place + 1] * share
    return result


def _cross(vectors: Array) -> Array:
    """Return the matrices (n, 3, 3) of the cross products with vectors (n, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    for row, column, axis, sign in (
        (2, 1, 0, 1),
        (0, 2, 1, 1),
        (1, 0, 2, 1),
        (1, 2, 0, -1),
        (2, 0, 1, -1),
        (0, 1, 2, -1),
    ):
        matrices[:, row, column] = sign * vectors[:, axis]
    return matrices
