"""What an inspection finds, as plain values."""

from dataclasses import asdict, dataclass, field
from typing import Any

import yaml


@dataclass(frozen=True)
class Suggestion:
    """A setting that fits the recording."""

    path: str
    """Such as ``config.data.stamp_at``; ``recipe`` for the recipe."""
    value: Any
    """None where only a person knows it."""
    reason: str
    form: str = ""
    """How the value is written where it is not known, such as [X,Y,Z]."""

    def option(self) -> str:
        """Return it as an option of ``lio-jax run``, its reason after '#'."""
        if self.path == "recipe":
            return f"--recipe {self.value}"
        return f"--set {self.path}={self.written().replace(' ', '')}  # {self.reason}"

    def written(self) -> str:
        """Return the value as YAML, or its form where it is not known."""
        return self.form or yaml.safe_dump(self.value, default_flow_style=True, width=10_000).split("\n")[0]


@dataclass(frozen=True)
class Inspection:
    """What was found; lengths in m, times in s, rates in Hz, angular rates in rad/s."""

    name: str
    format: str
    path: str
    sensor: str
    topics: list[dict[str, Any]]
    """name, type, messages and rate of each topic of a bag; none of other formats."""
    point_fields: list[str]
    """Name and type of the fields of a point in a bag's clouds, such as "x f4"."""
    sampled: str
    """What was left out of the look, "" where nothing was."""
    scans: int
    duration: float | None
    """From the first scan's start to the last one's end; None where no scan could be decoded."""
    scan_rate: float | None
    scan_jitter: float | None
    """Typical deviation of the time between scans."""
    scan_gaps: int
    """Steps between consecutive sampled scans longer than 1.8 median ones."""
    points_per_scan: dict[str, float]
    """min, median and max over the sampled scans."""
    dropped_share: float | None
    """Of the recorded points: NaN, infinite or zero."""
    rings: int
    """Number of different beam indices; 0 where there are none."""
    point_time: str
    """How the times of the points in a scan are spread."""
    scan_duration: float | None
    """Median over the sampled scans; 0: already compensated."""
    range_min: float | None
    range_max: float | None
    range_shares: dict[str, float]
    """Share of the points by range."""
    imu_samples: int
    imu_rate: float | None
    """By the median interval."""
    imu_jitter: float | None
    imu_gaps: int
    """Number of intervals longer than three median ones."""
    imu_longest_gap: float | None
    accel_magnitude: float | None
    """Median of |accel| as the reader gives it, m/s^2."""
    up_in_imu: list[float] | None
    """Unit vector of the mean specific force, at rest where there is rest."""
    tilt_deg: float | None
    """Between it and the lidar's z axis by the calibration, or with parallel axes without."""
    at_rest: bool
    """A second at rest was found."""
    gyro_noise: float | None
    """Density at rest, rad/s/sqrt(Hz)."""
    accel_noise: float | None
    """Density at rest, m/s^2/sqrt(Hz)."""
    turns: dict[str, Any] | None
    """The scans' turns against the gyroscope's; None where they cannot be compared."""
    gps_fixes: int
    truth_poses: int
    calibration: bool
    """Whether the recording holds T_imu_lidar."""
    missing: dict[str, list[str]]
    """What each recipe would want and does not find."""
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    suggestions: list[Suggestion] = field(default_factory=list)

    @property
    def suggested_config(self) -> list[str]:
        """Options of ``lio-jax run`` that fit, each with its reason after '#'."""
        return [suggestion.option() for suggestion in self.suggestions]

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists for JSON."""
        return asdict(self) | {"suggested_config": self.suggested_config}


def settings_text(found: Inspection) -> str:
    """Return a settings file for ``--recipe``: what the inspection suggests, each with its reason.

    What only a person knows stands there as a comment.
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
        # keys without a value that is known would hold nothing
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
