"""Where the odometry's world lies on the earth: heading and place of a level frame in another, from fixes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lio_jax.loops.graduated import truncated_weights

_Array = NDArray[np.float64]

_CONFIDENCE = 0.99
"""Share of right fixes whose squared whitened residual is below the limit."""
_MEDIAN = float(chi2.median(3))
_GROWTH = 1.4
"""Of the control parameter, from one set of weights to the next."""
_ROUNDS = 100
_STEPS = 3
"""Of Gauss-Newton, behind the closed form."""
_SETTLED = 1e-3
"""Weights this near to 0 or 1 change no more."""
_MOST_ALIKE = 0.98
"""Larger correlations of one residual with the next are not told apart."""


class Alignment(NamedTuple):
    """The level frame of the odometry in the fixes' frame."""

    T_enu_odom: _Array
    """(4, 4); turned about the vertical only."""
    covariance: _Array
    """(4, 4) of yaw (rad) and of the odometry's origin to the east, north and up (m)."""
    inlier: NDArray[np.bool_]
    """(k,) fixes that agree with it."""


class _Pairs(NamedTuple):
    """Positions of the antenna in both frames."""

    odometry: _Array
    fix: _Array
    root: _Array
    """(k, 3, 3) L of each fix's information L L'."""

    def residual(self, yaw: float, shift: _Array) -> _Array:
        """Return (k, 3) whitened residuals L' (Rz(yaw) p + t - f)."""
        missed = self.odometry @ _about_z(yaw).T + shift - self.fix
        return np.asarray(np.einsum("kji,kj->ki", self.root, missed))

    def slope(self, yaw: float) -> _Array:
        """Return their (k, 3, 4) derivatives by yaw and t."""
        turned = self.odometry @ _about_z(yaw).T
        by_yaw = np.stack([-turned[:, 1], turned[:, 0], np.zeros(len(turned))], -1)
        by_yaw = np.einsum("kji,kj->ki", self.root, by_yaw)
        return np.concatenate([by_yaw[:, :, None], self.root.transpose(0, 2, 1)], -1)


def alignment(
    positions_odom: _Array, fixes: _Array, covariances: _Array, yaw_sigma: float
) -> Alignment | None:
    """Return the yaw and translation that lay an odometry onto fixes; None while the yaw is not observable.

    Least sum of r' C^-1 r with r = Rz(yaw) p + t - f, truncated for fixes that contradict the others, by
    graduated non-convexity like a pose graph's edges (Yang et al., RA-L 2020). The covariance counts by how
    much residuals are larger than stated, and that errors of fixes follow each other: by (1 + a) / (1 - a),
    with a the correlation of one residual with the next.

    Not observable is a yaw whose standard deviation is above ``yaw_sigma``, or on which not even half of the
    fixes agree.

    Args:
        positions_odom: (k, 3) m, of the antenna by the odometry, z up; in order of time.
        fixes: (k, 3) m, east north up.
        covariances: (k, 3, 3) m^2 of the fixes, positive definite.
        yaw_sigma: rad.
    """
    if len(fixes) < 2:
        return None
    pairs = _Pairs(positions_odom, fixes, np.linalg.cholesky(np.linalg.inv(covariances)))
    yaw, shift, weights = _robust(pairs)
    inlier = weights > 0.5
    if 2 * np.sum(inlier) < len(fixes):
        return None
    covariance = _covariance(pairs, inlier, yaw, shift)
    if covariance is None or covariance[0, 0] > yaw_sigma**2:
        return None
    T_enu_odom = np.eye(4)
    T_enu_odom[:3, :3], T_enu_odom[:3, 3] = _about_z(yaw), shift
    return Alignment(T_enu_odom, covariance, inlier)


def _robust(pairs: _Pairs) -> tuple[float, _Array, _Array]:
    """Return yaw, shift and the weights of the pairs, 0 or 1 but for a few."""
    limit = float(chi2.ppf(_CONFIDENCE, 3))
    weights = np.ones(len(pairs.fix))
    control = 0.0
    for _ in range(_ROUNDS):
        yaw, shift = _solved(pairs, weights)
        squared = np.sum(pairs.residual(yaw, shift) ** 2, -1)
        # before, all may be small: then it is their ratios that count
        if control >= 1 and np.all(np.minimum(weights, 1 - weights) < _SETTLED):
            break
        # errors may be larger than stated for all: then it is their spread that tells which one is wrong
        share = squared / (limit * max(1.0, float(np.median(squared)) / _MEDIAN))
        largest = float(share.max())
        if not control:
            control = 1 / (2 * largest - 1) if largest > 1 else np.inf
        weights = truncated_weights(share, control)
        if not np.any(weights):
            break
        control *= _GROWTH
    return yaw, shift, weights


def _solved(pairs: _Pairs, weights: _Array) -> tuple[float, _Array]:
    """Return yaw and shift of least squares: in closed form for round covariances, then by Gauss-Newton."""
    p, f = pairs.odometry, pairs.fix
    share = weights * np.sum(pairs.root[:, :2, :2] ** 2, axis=(1, 2))
    share = share / share.sum()
    (x, y, _), (east, north, _) = (p - share @ p).T, (f - share @ f).T
    yaw = float(np.arctan2(share @ (x * north - y * east), share @ (x * east + y * north)))
    shift = share @ f - _about_z(yaw) @ (share @ p)
    root = np.sqrt(weights)[:, None]
    for _ in range(_STEPS):
        A = (root[:, :, None] * pairs.slope(yaw)).reshape(-1, 4)
        step = np.linalg.lstsq(A, -(root * pairs.residual(yaw, shift)).ravel(), rcond=None)[0]
        yaw, shift = yaw + float(step[0]), shift + step[1:]
    return yaw, shift


def _covariance(pairs: _Pairs, inlier: NDArray[np.bool_], yaw: float, shift: _Array) -> _Array | None:
    """Return (4, 4) of yaw and shift, None where the yaw is open."""
    A = pairs.slope(yaw)[inlier].reshape(-1, 4)
    scale = np.linalg.norm(A, axis=0) + np.finfo(float).tiny
    _, singular, right = np.linalg.svd(A / scale, full_matrices=False)
    if not singular[-1] > len(A) * np.finfo(float).eps:
        return None
    root = right.T / singular / scale[:, None]
    residual = pairs.residual(yaw, shift)[inlier]
    larger = max(1.0, float(np.sum(residual**2)) / max(residual.size - 4, 1))
    return np.asarray(root @ root.T * larger * _alike(residual))


def _alike(residual: _Array) -> float:
    """Return of how many residuals in a row one alone says as much, if correlation fades by a factor."""
    power = float(np.sum(residual**2))
    if power == 0:
        return 1.0
    a = min(max(float(np.sum(residual[1:] * residual[:-1])) / power, 0.0), _MOST_ALIKE)
    return (1 + a) / (1 - a)


def _about_z(yaw: float) -> _Array:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
