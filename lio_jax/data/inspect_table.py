"""Write an inspection for people to read."""

from lio_jax.data.inspect import Inspection


def format_inspection(inspection: Inspection) -> str:
    """Return a two-column table followed by notes, problems and the options that fit."""
    rows = _rows(inspection)
    width = max(len(label) for label, _ in rows)
    lines = [f"{label:<{width}}  {value}" for label, value in rows]
    for title, sentences in (
        ("Notes", inspection.notes),
        ("Problems", inspection.problems or ["none found"]),
        ("Fits: lio-jax run " + inspection.path, inspection.suggested_config),
    ):
        if sentences:
            lines += ["", title, *(f"  {sentence}" for sentence in sentences)]
    return "\n".join(lines)


def _rows(inspection: Inspection) -> list[tuple[str, str]]:
    points = inspection.points_per_scan
    imu = "none"
    if inspection.imu_samples:
        imu = (
            f"{inspection.imu_samples} samples, {_number(inspection.imu_rate, 'Hz', 1)}, "
            f"{inspection.imu_gaps} gap(s), |accel| {_number(inspection.accel_magnitude, 'm/s^2', 3)}"
        )
    return [
        ("recording", inspection.name),
        ("format", inspection.format + (f", {inspection.sensor}" if inspection.sensor else "")),
        ("scans", f"{inspection.scans} at {_number(inspection.scan_rate, 'Hz', 2)}"),
        ("duration", _number(inspection.duration, "s", 2)),
        ("points per scan", f"{points['median']:.0f} ({points['min']:.0f} to {points['max']:.0f})"),
        ("rings", str(inspection.rings) if inspection.rings else "none"),
        ("sweep", _number(inspection.scan_duration, "s", 4)),
        ("point times", inspection.point_time),
        ("range", f"{_number(inspection.range_min, 'm', 2)} to {_number(inspection.range_max, 'm', 1)}"),
        ("IMU", imu),
        ("GPS", f"{inspection.gps_fixes} fixes" if inspection.gps_fixes else "none"),
        ("truth", f"{inspection.truth_poses} poses" if inspection.truth_poses else "none"),
        ("calibration", "T_imu_lidar is known" if inspection.calibration else "none: T_imu_lidar is unknown"),
    ]


def _number(value: float | None, unit: str, decimals: int) -> str:
    return "unknown" if value is None else f"{value:.{decimals}f} {unit}"
