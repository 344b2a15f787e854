"""Faults that the rotations of scans and gyroscope indicate, as sentences with a remedy."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.inspection.findings import Suggestion
from lio_jax.inspection.motion import Agreement, in_degrees

_LEAST_CORRELATION = 0.8
_WRONG_DEG, _WRONG_AXIS_DEG = 5.0, 15.0
_NOT_CERTAIN_DEG = 4.0
_LARGEST_OFFSET_S = 0.02
_SIGMAS = 4.0
_OTHER_END = 0.2
"""An offset that differs from a sweep by less than this share of it points to the stamp's other end."""


def suspicions(
    found: Agreement, sweep: float | None, calibrated: bool, rate: float | None
) -> tuple[list[str], list[Suggestion]]:
    """Return one sentence for each suspected fault, and the settings that would correct it.

    Args:
        found: result of the comparison.
        sweep: duration of a scan, s.
        calibrated: whether the assumed axes come from a calibration.
        rate: rate of the inertial samples, Hz.
    """
    if in_degrees(found):
        sentence = (
            f"the gyroscope turns {found.scale:.0f} times as fast as the scans: it is in deg/s, multiply the "
            "recorded rates by pi/180 = 0.0174533."
        )
        return [sentence], []
    if found.correlation < _LEAST_CORRELATION:
        sentence = (
            f"scans and gyroscope show different rotations (correlation {found.correlation:.2f}): their "
            "clocks, units or axes differ, or the scans cannot be matched."
        )
        return [sentence], []
    said, settings = [], []
    if not 0.8 < found.scale < 1.25:
        said.append(f"the gyroscope's rates are {found.scale:.2f} times those of the scans: check its unit.")
    if found.mirrored:
        said.append(
            "the gyroscope's axes are a mirror image of the lidar's: one axis has the wrong sign, or two are "
            "exchanged; no T_imu_lidar can put that right, correct the recorded samples."
        )
    elif found.off_deg is not None:
        words, setting = _rotation(found, calibrated)
        said += words
        settings += setting
    words, setting = _clock(found, sweep, rate)
    return said + words, settings + setting


def _rotation(found: Agreement, calibrated: bool) -> tuple[list[str], list[Suggestion]]:
    off = found.off_deg or 0.0
    assumed = "the recording's T_imu_lidar" if calibrated else "identity"
    R, sigma = found.R_imu_lidar, found.rotation_sigma_deg
    if R is None or sigma is None:
        if off < _WRONG_AXIS_DEG:
            return [], []
        sentence = (
            f"the one direction about which scans and gyroscope turn differs by {off:.0f} deg from what "
            f"{assumed} says: the rotation in T_imu_lidar is wrong, or axes are exchanged."
        )
        return [sentence], []
    if off < max(_WRONG_DEG, _SIGMAS * sigma) or sigma > _NOT_CERTAIN_DEG:
        return [], []
    near = _quarter_turns(R)
    apart = float(np.degrees(Rotation.from_matrix(near.T @ R).magnitude()))
    taken, how = (near, "the nearest quarter turns") if apart < max(3.0, 3 * sigma) else (R, "as measured")
    quaternion = [round(value, 4) + 0.0 for value in Rotation.from_matrix(taken).as_quat().tolist()]
    sentence = (
        f"scans and gyroscope say that {assumed} is wrong by {off:.0f} deg (to {sigma:.1f} deg): the "
        f"rotation of T_imu_lidar is about {quaternion} (xyzw), {how}."
    )
    reason = "T_imu_lidar by the turns of scans and gyroscope"
    return [sentence], [Suggestion("params.extrinsics.rotation", quaternion, reason)]


def _clock(found: Agreement, sweep: float | None, rate: float | None) -> tuple[list[str], list[Suggestion]]:
    sigma = found.time_offset_sigma
    # an offset shorter than the interval of a slow IMU is not observable
    least = max(_LARGEST_OFFSET_S, 0.5 / rate if rate else 0.0)
    if sigma is None or abs(found.time_offset) < max(least, _SIGMAS * sigma):
        return [], []
    offset = round(found.time_offset, 3)
    said = (
        f"the gyroscope's clock differs from the scans' by {offset:+.3f} s (sigma {sigma:.3f} s; a scan "
        f"stamped t was taken at IMU time t {offset:+.3f} s)."
    )
    if sweep and abs(abs(offset) - sweep) < _OTHER_END * sweep:
        end = "end" if offset < 0 else "start"
        said += f" That is a sweep: the stamp may mark the scan's {end}, see config.data.stamp_at."
    return [said], [
        Suggestion("params.extrinsics.time_offset", offset, "by the turns of scans and gyroscope, s")
    ]


def _quarter_turns(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nearest rotation by quarter turns about the axes."""
    turns = Rotation.create_group("O").as_matrix()
    return turns[int(np.argmax(np.einsum("kij,ij->k", turns, R)))]
