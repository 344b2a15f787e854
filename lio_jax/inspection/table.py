"""Format an inspection as text."""

from lio_jax.inspection.findings import Inspection


def format_inspection(inspection: Inspection) -> str:
    """Return a two-column table, followed by topics, notes, problems and the options that fit."""
    rows = _rows(inspection)
    width = max(len(label) for label, _ in rows)
    lines = [f"{label:<{width}}  {value}" for label, value in rows]
    wants = [
        f"{recipe}: {'; '.join(sentences)}" for recipe, sentences in inspection.missing.items() if sentences
    ]
    for title, sentences in (
        ("Topics", _topics(inspection)),
        ("Notes", [*inspection.notes, *([inspection.sampled] if inspection.sampled else [])]),
        ("Problems", inspection.problems or ["none found"]),
        ("Not there", wants),
        ("Fits: lio-jax run " + inspection.path, inspection.suggested_config),
    ):
        if sentences:
            lines += ["", title, *(f"  {sentence}" for sentence in sentences)]
    return "\n".join(lines)


def _rows(found: Inspection) -> list[tuple[str, str]]:
    points = found.points_per_scan
    ranges = ", ".join(
        f"{100 * share:.0f} % {name}" for name, share in found.range_shares.items() if share >= 0.005
    )
    rhythm = _rhythm(found.scan_jitter, found.scan_gaps)
    none = "unknown" if found.dropped_share is None else f"{100 * found.dropped_share:.1f} % of the points"
    rows = [
        ("recording", found.name),
        ("format", found.format + (f", {found.sensor}" if found.sensor else "")),
        ("scans", f"{found.scans} at {_number(found.scan_rate, 'Hz', 2)}{rhythm}"),
        ("duration", _number(found.duration, "s", 2)),
        ("points per scan", f"{points['median']:.0f} ({points['min']:.0f} to {points['max']:.0f})"),
        ("no returns", none),
        ("point fields", ", ".join(found.point_fields)),
        ("rings", str(found.rings) if found.rings else "none"),
        ("sweep", _number(found.scan_duration, "s", 4)),
        ("point times", found.point_time),
        ("range", f"{_number(found.range_min, 'm', 2)} to {_number(found.range_max, 'm', 1)}"),
        ("ranges", ranges),
        ("IMU", _imu(found)),
        ("up", _up(found)),
        ("noise at rest", _noise(found)),
        ("turns", _turns(found)),
        ("GPS", f"{found.gps_fixes} fixes" if found.gps_fixes else "none"),
        ("truth", f"{found.truth_poses} poses" if found.truth_poses else "none"),
        ("calibration", "T_imu_lidar is known" if found.calibration else "none: T_imu_lidar is unknown"),
    ]
    return [(label, value) for label, value in rows if value]


def _imu(found: Inspection) -> str:
    if not found.imu_samples:
        return "none"
    return (
        f"{found.imu_samples} samples, {_number(found.imu_rate, 'Hz', 1)}"
        f"{_rhythm(found.imu_jitter, found.imu_gaps)}, |accel| {_number(found.accel_magnitude, 'm/s^2', 3)}"
    )


def _rhythm(jitter: float | None, gaps: int) -> str:
    steady = f", jitter {jitter * 1e3:.2g} ms" if jitter and jitter > 1e-6 else ""
    return f"{steady}, {gaps} gap(s)" if gaps else steady


def _up(found: Inspection) -> str:
    if found.up_in_imu is None or found.tilt_deg is None:
        return ""
    x, y, z = found.up_in_imu
    when = "at rest" if found.at_rest else "on average"
    return f"({x:.2f}, {y:.2f}, {z:.2f}) in IMU axes {when}, {found.tilt_deg:.0f} deg from the lidar's z"


def _noise(found: Inspection) -> str:
    if found.gyro_noise is None or found.accel_noise is None:
        return ""
    rate, force = f"{found.gyro_noise:.2g} rad/s/sqrt(Hz)", f"{found.accel_noise:.2g} m/s^2/sqrt(Hz)"
    return f"gyroscope {rate}, accelerometer {force}"


def _turns(found: Inspection) -> str:
    if not found.imu_samples:
        return ""
    if found.turns is None:
        return "too few or too slow to compare scans with the gyroscope"
    turns = found.turns
    words = [f"scans and gyroscope correlate to {turns['correlation']:.3f}, {turns['compared']} intervals"]
    if turns["rotation_imu_lidar"] is not None:
        words.append(f"axes agree to {turns['off_deg']:.1f} deg (sigma {turns['rotation_sigma_deg']:.1f})")
    else:
        words.append(f"about one direction, which agrees to {turns['off_deg']:.0f} deg")
    if turns["time_offset"] is not None:
        offset, sigma = turns["time_offset"] * 1e3, turns["time_offset_sigma"] * 1e3
        words.append(f"clocks to {offset:+.0f} ms (sigma {sigma:.1f})")
    return ", ".join(words)


def _topics(found: Inspection) -> list[str]:
    return [
        f"{topic['name']}  {topic['type']}  {topic['messages']} messages"
        + (f", {topic['rate']:.1f} Hz" if topic["rate"] else "")
        + (", read" if topic["read"] else "")
        for topic in found.topics
    ]


def _number(value: float | None, unit: str, decimals: int) -> str:
    return "unknown" if value is None else f"{value:.{decimals}f} {unit}"
