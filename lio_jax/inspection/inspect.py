"""What each recipe needs from a recording, and what the recording lacks."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.inspection.findings import Inspection, Suggestion, suspicions
from lio_jax.inspection.inertial import InertialSummary, overlap, summarised
from lio_jax.inspection.motion import THINNED_TO, Agreement, agreement, lidar_turns
from lio_jax.inspection.sampling import WINDOW_SCANS, Sampled, sampled
from lio_jax.inspection.scans import ScanSummary
from lio_jax.lidar.params import ScanConfig
from lio_jax.recipes import RECIPES
from lio_jax.run.fitted_settings import fitted_to_surroundings
from lio_jax.settings.settings import Settings

_FEW_RINGS = 4


def missing(scans: ScanSummary, imu: InertialSummary | None, calibrated: bool) -> dict[str, list[str]]:
    """Return, for each recipe, one sentence for each thing that the recording lacks."""
    times = not scans.time_spreads or max(scans.time_spreads) == 0.0
    without_times = (
        ["point times: the motion within a sweep is not compensated"] if times and scans.sweep else []
    )
    inertial = []
    if imu is None:
        inertial.append("inertial samples: the motion is predicted by constant velocity")
    elif not calibrated:
        inertial.append("T_imu_lidar: taken as identity until params.extrinsics.* are given")
    rings = [] if len(scans.rings) >= _FEW_RINGS else ["rings: features are found along them"]
    wants = {
        "default": [*inertial, *without_times],
        "fast_lio2": [*inertial, *without_times],
        "lio_sam": [
            *(["inertial samples: it does not run without"] if imu is None else inertial),
            *rings,
            *without_times,
        ],
        "loam": [*rings, *without_times],
    }
    nothing = [] if any(scans.counts) else ["scans with points"]
    return {recipe: nothing + wants.get(recipe, [*inertial, *without_times]) for recipe in RECIPES}


_TRACKED_WINDOWS = 4
_TRACKED_SCANS = 40
"""Number of scans for odometry in a recording that is examined as a whole."""


def inspect_sequence(sequence: Sequence, settings: Settings | None = None) -> Inspection:
    """Inspect a recording by its calibration, its inertial samples and some windows of scans.

    Args:
        sequence: the recording.
        settings: settings that a run would start from; None: the defaults.
    """
    settings = settings or Settings()
    look = sampled(sequence)
    scans, tracked = _scans(look)
    info = sequence.info
    T_imu_lidar = _assumed(sequence, settings)
    imu = summarised(look.imu_parts, T_imu_lidar)
    problems = [*sequence.warnings_so_far, *scans.problems(info.scan_count)]
    suggestions = [Suggestion("recipe", "default", "")]
    turns = None
    if imu is not None:
        covered = overlap(imu, look.whole, scans.starts_ns, scans.ends_ns)
        problems += [*imu.problems, *(f"IMU: {sentence}" for sentence in covered)]
        turns = _turns(sequence, settings, tracked, imu, T_imu_lidar)
        if T_imu_lidar is None:
            problems.append(
                "there is an IMU but no calibration to the lidar: identity is used unless one is set."
            )
    if turns is not None and imu is not None:
        messages, fixes = suspicions(turns, scans.sweep, T_imu_lidar is not None, imu.rate)
        problems += messages
        suggestions += fixes
    gps, truth = sequence.gps(), sequence.truth()
    suggestions += _suggestions(imu, T_imu_lidar is not None, scans, suggestions)
    return Inspection(
        name=info.name,
        format=info.format,
        path=info.path,
        sensor=info.sensor,
        **_contents(sequence),
        sampled=look.summary,
        scans=info.scan_count,
        duration=(max(scans.ends_ns) - min(scans.starts_ns)) * 1e-9 if scans.starts_ns else None,
        scan_rate=scans.rate,
        scan_jitter=scans.jitter,
        scan_gaps=len(scans.gaps),
        points_per_scan=scans.spread,
        dropped_share=scans.dropped_share,
        rings=len(scans.rings),
        point_time=scans.point_time,
        scan_duration=scans.sweep,
        range_min=min((low for low, _ in scans.ranges), default=None),
        range_max=max((high for _, high in scans.ranges), default=None),
        range_shares=scans.range_shares,
        imu_samples=imu.samples if imu else 0,
        imu_rate=imu.rate if imu else None,
        imu_jitter=imu.jitter if imu else None,
        imu_gaps=imu.gaps if imu else 0,
        imu_longest_gap=imu.longest_gap if imu else None,
        accel_magnitude=imu.accel_magnitude if imu else None,
        up_in_imu=_listed(imu.up) if imu else None,
        tilt_deg=imu.tilt_deg if imu else None,
        at_rest=imu is not None and imu.still,
        gyro_noise=imu.gyro_noise if imu else None,
        accel_noise=imu.accel_noise if imu else None,
        turns=_plain(turns),
        gps_fixes=0 if gps is None else len(gps.stamp_ns),
        truth_poses=0 if truth is None else len(truth),
        calibration=info.T_imu_lidar is not None,
        missing=missing(scans, imu, T_imu_lidar is not None),
        notes=list(dict.fromkeys(sequence.info.notes)),
        problems=list(dict.fromkeys(problems)),
        suggestions=suggestions,
    )


def _scans(look: Sampled) -> tuple[ScanSummary, list[list[LidarScan]]]:
    """Return the summary of the sampled scans, and thinned windows of these scans for odometry."""
    summary = ScanSummary()
    tracked: list[list[LidarScan]] = []
    for window in look.windows():
        summary.add(window)
        kept = [_thinned(scan) for scan in window.scans[:_TRACKED_SCANS] if len(scan.points)]
        if len(tracked) < _TRACKED_WINDOWS and len(kept) > WINDOW_SCANS // 4:
            tracked.append(kept)
    return summary, tracked


def _thinned(scan: LidarScan) -> LidarScan:
    """Return at most as many points as the odometry is compiled for, drawn uniformly."""
    count = len(scan.points)
    if count <= THINNED_TO:
        return scan
    # drawn at random, because an even stride would take the same beams of every firing
    chosen = np.sort(np.random.default_rng(0).choice(count, THINNED_TO, replace=False))
    return LidarScan(
        scan.stamp_ns,
        scan.points[chosen],
        scan.time[chosen],
        scan.ring[chosen],
        scan.intensity[chosen],
        scan.duration,
    )


def _assumed(sequence: Sequence, settings: Settings) -> NDArray[np.float64] | None:
    """Return the T_imu_lidar that a run would use; None where it is only a guess."""
    if any(path.startswith("params.extrinsics.rot") for path in settings.given):
        return np.asarray(settings.params().extrinsics.T_imu_lidar().as_matrix(), np.float64)
    return sequence.info.T_imu_lidar


def _turns(
    sequence: Sequence,
    settings: Settings,
    windows: list[list[LidarScan]],
    imu: InertialSummary,
    T_imu_lidar: NDArray[np.float64] | None,
) -> Agreement | None:
    windows = [window for window in windows if len(window) > 2]
    if not windows or not imu.parts:
        return None
    settings, _ = fitted_to_surroundings(sequence, settings)
    R_assumed = np.eye(3) if T_imu_lidar is None else T_imu_lidar[:3, :3]
    return agreement(lidar_turns(windows, settings), imu.parts, imu.gyro_bias, R_assumed)


def _contents(sequence: Sequence) -> dict[str, Any]:
    if not isinstance(sequence, RosbagSequence):
        return {"topics": [], "point_fields": []}
    contents = sequence.contents()
    length_s = (contents.end_ns - contents.start_ns) * 1e-9
    read = {topic.name for topic in (contents.lidar, contents.imu) if topic}
    topics = [
        {
            "name": topic.name,
            "type": topic.type,
            "messages": topic.count,
            "rate": round((topic.count - 1) / length_s, 3) if length_s > 0 and topic.count > 1 else None,
            "read": topic.name in read,
        }
        for topic in contents.topics
    ]
    return {"topics": topics, "point_fields": list(contents.point_fields)}


def _suggestions(
    imu: InertialSummary | None, calibrated: bool, scans: ScanSummary, made: list[Suggestion]
) -> list[Suggestion]:
    suggested = []
    if imu is not None and not calibrated:
        suggested.append(
            Suggestion("params.extrinsics.translation", None, "T_imu_lidar, m: from its manual", "[X,Y,Z]")
        )
        if not any(one.path == "params.extrinsics.rotation" for one in made):
            reason = "T_imu_lidar, quaternion"
            suggested.append(Suggestion("params.extrinsics.rotation", None, reason, "[X,Y,Z,W]"))
    if imu is not None and imu.in_g:
        suggested.append(Suggestion("config.data.accel_unit", "g", "|accel| is near 1 at rest"))
    buckets = ScanConfig().buckets
    if (largest := max(scans.counts, default=0)) > buckets[-1]:
        sizes = [*buckets, -(-largest // 65536) * 65536]
        reason = f"or scans are thinned to {buckets[-1]} points"
        suggested.append(Suggestion("config.lidar.buckets", sizes, reason))
    return suggested


def _plain(turns: Agreement | None) -> dict[str, Any] | None:
    if turns is None:
        return None
    R = turns.R_imu_lidar
    return {
        "compared": turns.turns,
        "correlation": round(turns.correlation, 4),
        "scale": round(turns.scale, 4),
        "rates": _listed(turns.rates),
        "time_offset": None if turns.time_offset_sigma is None else round(turns.time_offset, 4),
        "time_offset_sigma": turns.time_offset_sigma,
        "rotation_imu_lidar": None if R is None else _listed(Rotation.from_matrix(R).as_quat()),
        "rotation_sigma_deg": turns.rotation_sigma_deg,
        "off_deg": turns.off_deg,
        "mirrored": turns.mirrored,
    }


def _listed(values: NDArray[np.float64] | None) -> list[float] | None:
    return None if values is None else [round(float(value), 5) + 0.0 for value in values]
