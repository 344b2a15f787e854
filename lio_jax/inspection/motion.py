"""Compare the rotations of scans and gyroscope before the first run: axes, signs, units and clocks.

The scans' rotations come from LiDAR odometry of a few windows. With a the angular rate in the lidar's axes
and b in the IMU's, b = R_imu_lidar a. This is Wahba's problem, solved by the singular vectors of sum a b^T
(Markley, "Attitude determination using vector observations and the singular value decomposition", 1988). Its
singular values measure how well two records fit under any rotation; they also yield the shift between clocks.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.run.track import ScanResult, track
from lio_jax.settings.settings import Settings

THINNED_TO = 16384
_LEAST_TURNS = 6
_LEAST_RATE = 0.03
"""A direction about which the rms rate is below this is not observable, rad/s."""
_SHIFTS_S = np.arange(-0.5, 0.5001, 0.005)
_DEGREES_RANGE = (40.0, 75.0)
"""Range of the ratio of the rates that indicates deg/s: deg/s taken as rad/s gives 57.3."""


@dataclass(frozen=True)
class Turns:
    """Mean angular rates of the lidar between scans."""

    start_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    rate: NDArray[np.float64]
    """Mean angular rate of each interval, (n, 3) rad/s, lidar axes."""


@dataclass(frozen=True)
class Agreement:
    """Comparison of the gyroscope's rotations with the scans'."""

    turns: int
    """Number of intervals compared."""
    rates: NDArray[np.float64]
    """Rms rate about the principal directions of the scans' rotations, (3,) rad/s, largest first."""
    scale: float
    """Ratio of the gyroscope's rates to the scans' rates."""
    correlation: float
    """Correlation of the rates at the best clock offset, 0 to 1, under the best rotation between the axes."""
    time_offset: float
    """A scan stamped t was taken at IMU time t + time_offset, s; 0 where it is not observable."""
    time_offset_sigma: float | None
    """Standard deviation of ``time_offset``, s; None where it is not observable."""
    R_imu_lidar: NDArray[np.float64] | None
    """Rotation from lidar axes to IMU axes, (3, 3); None where all rotations are about one direction."""
    rotation_sigma_deg: float | None
    off_deg: float | None
    """Angle between assumed and observed rotation, deg; of the axis alone if ``R_imu_lidar`` is None."""
    mirrored: bool
    """Whether one axis or all have the opposite sign, so that no rotation explains the rates."""


def lidar_turns(windows: list[list[LidarScan]], settings: Settings) -> Turns:
    """Return the rotations between the scans of each window by LiDAR odometry.

    Args:
        windows: consecutive scans in each window.
        settings: recipe and values; only the lidar's axes are used.
    """
    settings = settings.with_value("config.imu.use", False, "inspection")
    settings = settings.with_value("config.lidar.buckets", [THINNED_TO], "inspection")
    settings = settings.with_value("params.extrinsics.rotation", [0.0, 0.0, 0.0, 1.0], "inspection")
    settings = settings.with_value("params.extrinsics.translation", [0.0, 0.0, 0.0], "inspection")
    starts, ends, rates = [], [], []
    for scans in windows:
        found = [
            (_middle_ns(scan), _attitude(tracked), bool(tracked.failure))
            for scan, tracked in zip(scans, track(settings, scans), strict=True)
        ]
        # the velocity that compensates the first scan is known from the second one only
        for (start, before, lost), (end, after, also_lost) in pairwise(found[1:]):
            if lost or also_lost or end <= start:
                continue
            turned = Rotation.from_matrix(before.T @ after).as_rotvec()
            starts.append(start)
            ends.append(end)
            rates.append(turned / ((end - start) * 1e-9))
    return Turns(np.array(starts, np.int64), np.array(ends, np.int64), np.array(rates).reshape(-1, 3))


def _middle_ns(scan: LidarScan) -> int:
    """Return the time of the match's pose; the pose at the scan's end is extrapolated from it."""
    return scan.stamp_ns + round(scan.duration / 2 * 1e9)


def _attitude(tracked: ScanResult) -> NDArray[np.float64]:
    wxyz = np.asarray(tracked.output.registration.T_world_lidar.wxyz_xyz, np.float64)[:4]
    return Rotation.from_quat(wxyz, scalar_first=True).as_matrix()


def agreement(
    turns: Turns,
    parts: list[ImuData],
    gyro_bias: NDArray[np.float64] | None,
    R_assumed: NDArray[np.float64],
) -> Agreement | None:
    """Compare the rotations; return None where they are too few or too small.

    Args:
        turns: rotations of the lidar.
        parts: inertial samples, consecutive in each part.
        gyro_bias: (3,) rad/s, measured at rest; None where unknown.
        R_assumed: (3, 3) R_imu_lidar that a run would use.
    """
    integrals = [_Integral(part, gyro_bias) for part in parts if len(part.stamp_ns) > 1]
    seen = [_gyro_rates(turns, integrals, shift) for shift in _SHIFTS_S]
    common = np.all([np.isfinite(rates).all(axis=1) for rates in seen], axis=0)
    if np.count_nonzero(common) < _LEAST_TURNS:
        # a recording too short for a clock shift still shows the axes
        seen, common = [], np.isfinite(_gyro_rates(turns, integrals, 0.0)).all(axis=1)
    if np.count_nonzero(common) < _LEAST_TURNS:
        return None
    a = turns.rate[common]
    principal = np.sqrt(np.maximum(np.linalg.eigvalsh(a.T @ a / len(a))[::-1], 0.0))
    if principal[0] < _LEAST_RATE:
        return None
    offset, sigma = _clock(turns, integrals, seen, common)
    b = _gyro_rates(turns, integrals, offset)[common]
    scale = float(np.sqrt(np.sum(b**2) / np.sum(a**2)))
    correlation = _fit(a, b)
    residual_share = np.sqrt(max(0.0, 1.0 - correlation**2))
    b = b / scale
    noise = max(residual_share * float(np.sqrt(np.mean(a**2))), 1e-4)
    R, mirrored = _wahba(a, b)
    observed = principal[1] > max(_LEAST_RATE, 2.0 * noise)
    if observed:
        rotation_sigma = float(np.degrees(noise / (np.sqrt(len(a)) * principal[1])))
        off = float(np.degrees(Rotation.from_matrix(R_assumed.T @ R).magnitude()))
    else:
        rotation_sigma, mirrored = None, False
        off = _axis_apart(a, b, R_assumed)
    return Agreement(
        turns=len(a),
        rates=principal,
        scale=scale,
        correlation=correlation,
        time_offset=offset,
        time_offset_sigma=sigma,
        R_imu_lidar=R if observed else None,
        rotation_sigma_deg=rotation_sigma,
        off_deg=off,
        mirrored=mirrored,
    )


def in_degrees(found: Agreement) -> bool:
    """Return whether the gyroscope's rates are the scans' rates in deg/s."""
    return _DEGREES_RANGE[0] < found.scale < _DEGREES_RANGE[1]


class _Integral:
    """Integral of the angular rate since a part's first sample."""

    def __init__(self, imu: ImuData, bias: NDArray[np.float64] | None) -> None:
        gyro = imu.gyro - (0.0 if bias is None else bias)
        self.origin = int(imu.stamp_ns[0])
        self.seconds = (imu.stamp_ns - self.origin) * 1e-9
        steps = np.diff(self.seconds)[:, None] * (gyro[1:] + gyro[:-1]) / 2
        self.angle = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def at(self, stamp_ns: NDArray[np.int64], shift: float) -> NDArray[np.float64]:
        """Return (n, 3) rad at the stamps shifted by ``shift`` s; NaN outside the part."""
        seconds = (stamp_ns - self.origin) * 1e-9 + shift
        columns = [np.interp(seconds, self.seconds, column, np.nan, np.nan) for column in self.angle.T]
        return np.stack(columns, axis=1)


def _gyro_rates(turns: Turns, integrals: list[_Integral], shift: float) -> NDArray[np.float64]:
    rates = np.full_like(turns.rate, np.nan)
    for integral in integrals:
        turned = integral.at(turns.end_ns, shift) - integral.at(turns.start_ns, shift)
        within = np.isfinite(turned).all(axis=1)
        rates[within] = turned[within] / ((turns.end_ns - turns.start_ns)[within, None] * 1e-9)
    return rates


def _clock(
    turns: Turns, integrals: list[_Integral], seen: list[NDArray[np.float64]], common: NDArray[np.bool_]
) -> tuple[float, float | None]:
    """Return the shift (s) at which the records fit best, and its sigma (s); None where not observable."""
    if not seen:
        return 0.0, None
    a = turns.rate[common] - turns.rate[common].mean(axis=0)
    fits = np.array([_fit(a, b[common] - b[common].mean(axis=0)) for b in seen])
    best = int(np.argmax(fits))
    if not 0 < best < len(fits) - 1:
        return 0.0, None
    below, top, above = fits[best - 1 : best + 2]
    bend = below - 2 * top + above
    offset = float(_SHIFTS_S[best] + (0.5 * (below - above) / bend * 0.005 if bend < 0 else 0.0))
    b = seen[best][common]
    noise = np.sqrt(max(1.0 - top**2, 1e-6) * np.mean((b - b.mean(axis=0)) ** 2))
    slope = (seen[best + 1][common] - seen[best - 1][common]) / 0.01
    steepness = float(np.sqrt(np.sum(slope**2)))
    sigma = float(noise) / steepness if steepness > 0 else np.inf
    return (offset, sigma) if sigma < 0.02 and top > 0.8 else (0.0, None)


def _fit(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the correlation of two vector records under the best rotation or reflection."""
    norms = np.sqrt(np.sum(a**2) * np.sum(b**2))
    return float(np.linalg.svd(a.T @ b, compute_uv=False).sum() / norms) if norms > 0 else 0.0


def _wahba(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
    """Return R with b = R a, and whether only a reflection fits (if all three directions are observable)."""
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = float(np.sign(np.linalg.det(u @ vt)))
    rotation = u @ np.diag([1.0, 1.0, sign]) @ vt
    # the misfit that the third direction adds, compared with the smallest that remains of it
    best = np.sum(b**2) + np.sum(a**2) - 2 * values.sum()
    mirrored = sign < 0 and 4 * values[2] > 3 * max(best, 1e-12) and values[2] > 0.05 * values[0]
    return rotation, bool(mirrored)


def _axis_apart(a: NDArray[np.float64], b: NDArray[np.float64], R_assumed: NDArray[np.float64]) -> float:
    """Return the angle (deg) between the assumed and the observed axis, for rotations about one direction."""
    _, _, directions = np.linalg.svd(a, full_matrices=False)
    axis = directions[0]
    seen = b.T @ (a @ axis)
    return float(np.degrees(np.arccos(np.clip(seen @ (R_assumed @ axis) / np.linalg.norm(seen), -1.0, 1.0))))
