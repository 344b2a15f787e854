"""What was found in a recording, and what is suspicious about it."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.inspection.motion import Agreement, in_degrees


@dataclass(frozen=True)
class Suggestion:
    """A setting that fits the recording."""

    path: str
    """Path of the setting, for example ``config.data.stamp_at``; ``recipe`` for the recipe."""
    value: Any
    """Suggested value; None where only the user can know it."""
    reason: str
    """Why the value fits the recording."""
    form: str = ""
    """How to write a value that is not known, for example [X,Y,Z]."""

    def option(self) -> str:
        """Return the suggestion as an option of ``lio-jax run``, with its reason after '#'."""
        if self.path == "recipe":
            return f"--recipe {self.value}"
        return f"--set {self.path}={self.written().replace(' ', '')}  # {self.reason}"

    def written(self) -> str:
        """Return the value as YAML, or the form of a value that is not known."""
        return self.form or yaml.safe_dump(self.value, default_flow_style=True, width=10_000).split("\n")[0]


@dataclass(frozen=True)
class Inspection:
    """All results; lengths in m, times in s, rates in Hz, angular rates in rad/s."""

    name: str
    format: str
    path: str
    sensor: str
    topics: list[dict[str, Any]]
    """Name, type, number of messages and rate of each topic of a bag; empty for other formats."""
    point_fields: list[str]
    """Name and type of each field of a point in a bag's clouds, for example "x f4"."""
    sampled: str
    """Sentence on the parts of the recording that were not examined; "" if all were."""
    scans: int
    duration: float | None
    """Time from the first scan's start to the last scan's end, s; None where no scan could be decoded."""
    scan_rate: float | None
    scan_jitter: float | None
    """Typical deviation of the time between scans, s."""
    scan_gaps: int
    """Number of steps between consecutive sampled scans that are longer than 1.8 median steps."""
    points_per_scan: dict[str, float]
    """Minimum, median and maximum number of points in the sampled scans."""
    dropped_share: float | None
    """Share of the recorded points that are NaN, infinite or zero."""
    rings: int
    """Number of different beam indices; 0 where the recording has none."""
    point_time: str
    """Sentence on how the times of the points are distributed in a scan."""
    scan_duration: float | None
    """Median duration of the sampled scans, s; 0: already compensated."""
    range_min: float | None
    range_max: float | None
    range_shares: dict[str, float]
    """Share of the points in each interval of range."""
    imu_samples: int
    imu_rate: float | None
    """Rate by the median interval, Hz."""
    imu_jitter: float | None
    imu_gaps: int
    """Number of intervals that are longer than three median intervals."""
    imu_longest_gap: float | None
    accel_magnitude: float | None
    """Median of |accel| as the reader returns it, m/s^2."""
    up_in_imu: list[float] | None
    """Unit vector of the mean specific force, IMU frame; at rest if a rest was found."""
    tilt_deg: float | None
    """Angle between ``up_in_imu`` and the lidar's z axis, deg; uncalibrated axes count as parallel."""
    at_rest: bool
    """Whether a second at rest was found."""
    gyro_noise: float | None
    """White noise density of the gyroscope at rest, rad/s/sqrt(Hz)."""
    accel_noise: float | None
    """White noise density of the accelerometer at rest, m/s^2/sqrt(Hz)."""
    turns: dict[str, Any] | None
    """Rotations of the scans compared with the gyroscope's; None where they cannot be compared."""
    gps_fixes: int
    truth_poses: int
    calibration: bool
    """Whether the recording holds T_imu_lidar."""
    missing: dict[str, list[str]]
    """Sentences by recipe on what the recipe needs and the recording lacks."""
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    suggestions: list[Suggestion] = field(default_factory=list)

    @property
    def suggested_config(self) -> list[str]:
        """Suggested options of ``lio-jax run``, each with its reason after '#'."""
        return [suggestion.option() for suggestion in self.suggestions]

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists, for JSON."""
        return asdict(self) | {"suggested_config": self.suggested_config}


def settings_text(found: Inspection) -> str:
    """Return a settings file for ``--recipe`` with the inspection's suggestions, each with its reason.

    A value that only the user can know is left as a comment.
    """
    lines = [f"# for {found.path}", "# what is not set here keeps the recipe's value"]
    sections: dict[str, dict[str, list[Suggestion]]] = {}
    for suggestion in found.suggestions:
        if suggestion.path == "recipe":
            lines.append(f"recipe: {suggestion.value}")
            continue
        kind, section, _ = suggestion.path.split(".", 2)
        sections.setdefault(kind, {}).setdefault(section, []).append(suggestion)
    for kind, groups in sections.items():
        # a key whose values are all unknown would be empty
        known = any(one.value is not None for group in groups.values() for one in group)
        lines.append(f"{'' if known else '# '}{kind}:")
        for section, group in groups.items():
            known = any(one.value is not None for one in group)
            lines.append(f"{'' if known else '# '}  {section}:")
            lines += [_line(one) for one in group]
    return "\n".join(lines) + "\n"


def _line(suggestion: Suggestion) -> str:
    name = suggestion.path.split(".", 2)[2]
    if suggestion.value is None:
        return f"#    {name}: {suggestion.written()}  # {suggestion.reason}"
    return f"    {name}: {suggestion.written()}  # {suggestion.reason}"


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
    messages, settings = [], []
    if not 0.8 < found.scale < 1.25:
        messages.append(
            f"the gyroscope's rates are {found.scale:.2f} times those of the scans: check its unit."
        )
    if found.mirrored:
        messages.append(
            "the gyroscope's axes are a mirror image of the lidar's: one axis has the wrong sign, or two are "
            "exchanged; no T_imu_lidar can put that right, correct the recorded samples."
        )
    elif found.off_deg is not None:
        words, setting = _rotation(found, calibrated)
        messages += words
        settings += setting
    words, setting = _clock(found, sweep, rate)
    return messages + words, settings + setting


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
    message = (
        f"the gyroscope's clock differs from the scans' by {offset:+.3f} s (sigma {sigma:.3f} s; a scan "
        f"stamped t was taken at IMU time t {offset:+.3f} s)."
    )
    if sweep and abs(abs(offset) - sweep) < _OTHER_END * sweep:
        end = "end" if offset < 0 else "start"
        message += f" That is a sweep: the stamp may mark the scan's {end}, see config.data.stamp_at."
    return [message], [
        Suggestion("params.extrinsics.time_offset", offset, "by the turns of scans and gyroscope, s")
    ]


def _quarter_turns(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nearest rotation by quarter turns about the axes."""
    turns = Rotation.create_group("O").as_matrix()
    return turns[int(np.argmax(np.einsum("kij,ij->k", turns, R)))]
