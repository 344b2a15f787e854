"""Poses in the middles of sweeps by the scan matches alone, for the fit of the set-up.

There a pose does not depend on the compensation, which would repeat the assumed set-up.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.run.set_up_fit import Poses, Samples, SetUp
from lio_jax.run.track import ScanResult

_LEAST_INFORMATION = 1e-4
"""Directions with a smaller share of the strongest one's information are left where they are."""


class SweptScan(NamedTuple):
    """A scan and its match, as they are kept until the window is full."""

    end: float
    """s since the run's origin, on the lidar's clock."""
    half: float
    """Half of the sweep's duration, s."""
    rate: NDArray[np.float64]
    """Mean angular rate in the second half of the sweep, (3,) rad/s, IMU axes."""
    velocity: NDArray[np.float64]
    """Velocity of the IMU in world, (3,) m/s."""
    wxyz_xyz: NDArray[np.float64]
    """T_world_lidar at the end."""
    information: NDArray[np.float64]
    """Information of the scan match, (6, 6); zero where the pose itself is that of the match."""
    gradient: NDArray[np.float64]
    """Gradient of the match's cost at the pose, (6,)."""


def swept_scan(result: ScanResult, samples: Samples, set_up: SetUp, end: float) -> SweptScan | None:
    """Return what is kept of a scan; None if its sweep is without samples.

    Args:
        result: of the scan.
        samples: all of the run.
        set_up: as assumed in the compensation.
        end: the scan's end by the lidar's clock, s since the run's origin.
    """
    half = result.duration / 2
    edges = [end - half + set_up.time_offset, end + set_up.time_offset]
    first, last = np.searchsorted(samples.seconds, edges).tolist()
    if half and first == last:
        return None
    nav, evidence = result.nav, result.output.evidence
    rate = samples.gyro[first:last].mean(axis=0) - nav.gyro_bias if half else np.zeros(3)
    return SweptScan(
        end,
        half,
        rate,
        np.asarray(nav.velocity, np.float64),
        np.asarray(result.output.registration.T_world_lidar.wxyz_xyz, np.float64),
        np.zeros((6, 6)) if evidence is None else np.asarray(evidence.information, np.float64),
        np.zeros(6) if evidence is None else np.asarray(evidence.gradient, np.float64),
    )


def poses_amid_sweeps(scans: list[SweptScan], set_up: SetUp) -> Poses:
    """Return the lidar's poses in the middles of the sweeps by the scan matches alone.

    There a pose does not depend on the compensation, which would repeat the assumed set-up. A filter's pose
    lies between prediction and match; the gradient of the match's cost leads back to the match.

    Args:
        scans: of a window.
        set_up: as assumed in the compensation.
    """
    end, half, rate, velocity, wxyz_xyz, information, gradient = map(np.array, zip(*scans, strict=True))
    step = _to_the_match(information, gradient)
    rotation = Rotation.from_rotvec(step[:, :3]) * Rotation.from_quat(wxyz_xyz[:, :4], scalar_first=True)
    to_lidar = set_up.R_imu_lidar.inv()
    swing = rotation.apply(to_lidar.apply(np.cross(rate, set_up.t_imu_lidar)))
    moved = (velocity + swing) * half[:, None]
    turn = Rotation.from_rotvec(to_lidar.apply(rate) * half[:, None])
    return Poses(end - half, (rotation * turn.inv()).as_matrix(), wxyz_xyz[:, 4:] + step[:, 3:] - moved)


def _to_the_match(information: NDArray[np.float64], gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the steps (n, 6) from a filter's poses to the minima of the matches' costs, world axes."""
    values, vectors = np.linalg.eigh(information)
    strong = values > np.maximum(_LEAST_INFORMATION * values[:, -1:], 1e-300)
    inverse = np.where(strong, 1 / np.where(strong, values, 1.0), 0.0)
    along = np.einsum("nij,ni->nj", vectors, gradient)
    return -np.einsum("nij,nj->ni", vectors, inverse * along)
