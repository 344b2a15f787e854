"""The figures of a run for its report."""

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from lio_jax.core.error_state import ACCEL_BIAS, GYRO_BIAS
from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.kitti_segments import relative_errors, segment_ends
from lio_jax.evaluation.trajectory_error import position_errors
from lio_jax.viz.html import figure
from lio_jax.viz.run_record import RunRecord, TruthComparison
from lio_jax.viz.svg import WIDTH, Line, box_chart, empty, equal_axes, line_chart, plan_chart, stack_chart

_INK = (108, 122, 136)
"""A grey that is visible on white and on black; the count of points in a pixel sets its opacity."""
_FAINTEST = 60
_FULL_PERCENTILE = 98.0


def map_png(
    points: NDArray[np.floating], x: tuple[float, float], y: tuple[float, float], width: int
) -> bytes:
    """Return a picture with the same scale in both directions; pixels without points are transparent.

    The more points are above each other, the darker the pixel: walls and trunks differ from ground and
    ceiling.

    Args:
        points: (n, 3) m, world frame, z up.
        x: left and right edge, m.
        y: lower and upper edge, m.
        width: width in pixels; the height follows from the scale.
    """
    scale = width / (x[1] - x[0])
    height = max(1, round((y[1] - y[0]) * scale))
    column, row = np.floor((points[:, 0] - x[0]) * scale), np.floor((y[1] - points[:, 1]) * scale)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = (row[inside] * width + column[inside]).astype(np.int64)
    count = np.bincount(place, minlength=width * height)
    full = max(2.0, float(np.percentile(count[count > 0], _FULL_PERCENTILE))) if len(place) else 2.0
    share = np.clip(np.log1p(count) / np.log1p(full), 0.0, 1.0)
    opacity = np.where(count > 0, _FAINTEST + share * (255 - _FAINTEST), 0.0)
    return _ink_png(opacity.astype(np.uint8).reshape(height, width))


def data_uri(png: bytes) -> str:
    """Return a picture as an address that contains the data."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _ink_png(opacity: NDArray[np.uint8]) -> bytes:
    """Encode one colour with varying opacity (PNG, W3C recommendation, third edition: palette with tRNS)."""
    height, width = opacity.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), opacity], axis=1)
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", bytes(_INK) * 256),
        (b"tRNS", bytes(range(256))),
        (b"IDAT", zlib.compress(rows.tobytes(), 6)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


_TIME, _WAY = "time [s]", "distance travelled [m]"
_MAP_PIXELS = 1200
_RPE_LENGTHS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 400.0, 800.0)
_RPE_BOXES = 5
_LEAST_PAIRS = 4
_AXES = [("x", 0), ("y", 1), ("z", 2)]


def from_above(run: RunRecord) -> list[str]:
    """Return map and path from above, to scale: first the whole map, then the path alone."""
    xy = run.trajectory.positions[:, :2]
    lines = [Line(xy[:, 0], xy[:, 1], 0)]
    legend = [("estimate", 0)]
    if run.comparison:
        truth = run.comparison.truth.positions
        lines.append(Line(truth[:, 0], truth[:, 1], 1, dashed=True))
        legend.append(("truth, aligned", 1))
    points = run.map_points()
    path = [line.x for line in lines], [line.y for line in lines]
    axes = equal_axes(*path, width=WIDTH)
    if axes is None:
        return [figure("Way from above", empty("no pose is finite"))]
    drawn = [figure("Way from above", plan_chart(axes, lines, "x [m]", "y [m]"), "To scale.", legend)]
    if points is None or not len(points):
        return drawn
    low, high = np.percentile(points[:: max(1, len(points) // 100_000), :2], [1.0, 99.0], axis=0)
    whole = equal_axes([*path[0], np.array([low[0], high[0]])], [*path[1], np.array([low[1], high[1]])])
    assert whole is not None  # the whole map includes the path
    edges = (whole.x_low, whole.x_high), (whole.y_low, whole.y_high)
    behind = data_uri(map_png(points, *edges, _MAP_PIXELS))
    svg = plan_chart(whole, lines, "x [m]", "y [m]", behind)
    caption = "The map's points in grey, darker where more stand above each other."
    return [figure("Map from above", svg, caption, legend, wide=True), *drawn]


def loops_closed(run: RunRecord) -> list[str]:
    """Return the path before and after its correction, with the loops between keyframes."""
    found = run.correction
    if found is None:
        return []
    before, after = run.odometry.positions, run.trajectory.positions
    lines = [Line(before[:, 0], before[:, 1], 1, dashed=True), Line(after[:, 0], after[:, 1], 0)]
    legend = [("odometry", 1), ("corrected", 0)]
    for closed, name, series in ((False, "refused", 7), (True, "closed", 2)):
        strips = found.strips(closed)
        # a value that is not finite separates the loops from each other
        apart = np.concatenate([strips, np.full((len(strips), 1, 3), np.nan)], axis=1).reshape(-1, 3)
        if len(strips):
            lines.append(Line(apart[:, 0], apart[:, 1], series))
            legend.append((f"loops {name}", series))
    axes = equal_axes([line.x for line in lines], [line.y for line in lines], width=WIDTH)
    if axes is None:
        return [figure("Loops", empty("no pose is finite"))]
    svg = plan_chart(axes, lines, "x [m]", "y [m]")
    return [figure("Loops", svg, "From above, to scale.", legend, wide=True)]


def from_the_side(run: RunRecord) -> str:
    """Return the height over the distance travelled."""
    lines, legend = [Line(run.distance, run.trajectory.positions[:, 2], 0)], [("estimate", 0)]
    if run.comparison:
        way = way_of(run, run.comparison.matched.estimate)
        lines.append(Line(way, run.comparison.truth.positions[:, 2], 1, dashed=True))
        legend.append(("truth, aligned", 1))
    return figure("From the side", line_chart(lines, _WAY, "z [m]"), "Height over the way.", legend)


def errors(run: RunRecord, compared: TruthComparison) -> list[str]:
    """Return position and attitude error over the distance travelled and over time."""
    matched = compared.matched
    metres = position_errors(compared.alignment, matched.estimate.poses, matched.reference.poses)
    turn = compared.alignment.T_reference_estimate_attitude[:3, :3]
    apart = np.swapaxes(matched.reference.poses[:, :3, :3], 1, 2) @ turn @ matched.estimate.poses[:, :3, :3]
    degrees = np.degrees(Rotation.from_matrix(apart).magnitude())
    how = "least squares" if compared.alignment.method == "umeyama" else "the first pose"
    drawn = []
    for x, label, over in (
        (way_of(run, matched.estimate), _WAY, "distance"),
        (run.seconds_of(matched.estimate), _TIME, "time"),
    ):
        marks = _failed_at(run, run.distance if over == "distance" else run.seconds)
        position = line_chart([Line(x, metres, 0)], label, "position error [m]", marks=marks, from_zero=True)
        attitude = line_chart(
            [Line(x, degrees, 1)], label, "attitude error [deg]", marks=marks, from_zero=True
        )
        rmse = float(np.sqrt(np.mean(metres**2)))
        drawn.append(figure(f"Position error over {over}", position, f"Aligned by {how}; rmse {rmse:.3g} m."))
        drawn.append(figure(f"Attitude error over {over}", attitude, f"Mean {degrees.mean():.3g} deg."))
    return drawn


def relative_error_boxes(compared: TruthComparison) -> list[str]:
    """Return the relative pose error over several distances, from every pose on."""
    metres, degrees = relative_error_groups(compared)
    caption = "From every pose on; box: quartiles, whiskers: 5 and 95 %, dot: largest."
    return [
        figure("Relative position error", box_chart(metres, "error [% of the way]"), caption),
        figure("Relative attitude error", box_chart(degrees, "error [deg]"), caption),
    ]


def relative_error_groups(compared: TruthComparison) -> tuple[dict[str, NDArray], dict[str, NDArray]]:
    """Return errors in % and in deg by distance, for the longest distances with enough pairs."""
    matched = compared.matched
    reference = matched.reference.poses
    starts = np.arange(len(reference))
    metres, degrees = {}, {}
    for length in _RPE_LENGTHS_M:
        ends = segment_ends(reference, starts, np.array([length]))[:, 0]
        fits = ends < len(reference)
        if np.count_nonzero(fits) < _LEAST_PAIRS:
            break
        moved, turned = relative_errors(matched.estimate.poses, reference, starts[fits], ends[fits])
        metres[f"{length:g} m"], degrees[f"{length:g} m"] = 100.0 * moved / length, np.degrees(turned)
    kept = list(metres)[-_RPE_BOXES:]
    return {name: metres[name] for name in kept}, {name: degrees[name] for name in kept}


def belief(run: RunRecord) -> list[str]:
    """Return biases with sigma, the pose's sigma, and the NIS: state and confidence of the filter."""
    drawn = []
    sigma = None
    if "state_covariance" in run.states:
        sigma = np.sqrt(np.maximum(np.diagonal(run.states["state_covariance"], axis1=1, axis2=2), 0.0))
    if np.any(run.states["biases"]):
        for name, unit, columns, states in (
            ("Gyroscope bias", "rad/s", slice(0, 3), GYRO_BIAS),
            ("Accelerometer bias", "m/s^2", slice(3, 6), ACCEL_BIAS),
        ):
            bias = run.states["biases"][:, columns]
            spread = None if sigma is None else sigma[:, states]
            lines = [
                Line(run.seconds, bias[:, i], i, sigma=None if spread is None else spread[:, i])
                for _, i in _AXES
            ]
            caption = "IMU axes" + (", with one sigma." if sigma is not None else ".")
            drawn.append(figure(name, line_chart(lines, _TIME, f"bias [{unit}]"), caption, _AXES))
    variances = np.diagonal(run.states["covariance"], axis1=1, axis2=2)
    if np.isfinite(variances).any():
        pose = np.sqrt(np.where(variances > 0, variances, np.nan))
        whose = "the filter's" if sigma is not None else "of the match with the map alone"
        for name, unit, columns, factor in (
            ("Sigma of the position", "m", slice(3, 6), 1.0),
            ("Sigma of the attitude", "deg", slice(0, 3), 180.0 / np.pi),
        ):
            values = pose[:, columns] * factor
            lines = [Line(run.seconds, values[:, i], i) for _, i in _AXES]
            svg = line_chart(lines, _TIME, f"sigma [{unit}]", log=True)
            drawn.append(figure(name, svg, f"IMU axes, {whose}.", _AXES))
    return [*drawn, *innovations(run)]


def innovations(run: RunRecord) -> list[str]:
    """Return the NIS with the band that contains 95 % of a consistent filter's values."""
    freedom = run.states["nis_dof"]
    known = freedom > 0
    if not known.any():
        return []
    low, high = nis_band(freedom)
    nis = np.where(known, run.states["nis"], np.nan)
    inside = float(np.mean((nis[known] >= low[known]) & (nis[known] <= high[known])))
    caption = (
        f"{100 * inside:.0f} % of the scans lie within the 95 % band. Above it the filter is surer than it "
        "is right, below it less sure than it could be."
    )
    line = Line(run.seconds, nis, 0)
    svg = line_chart([line], _TIME, "NIS", band=(run.seconds, low, high), log=True)
    return [figure("Normalised innovation squared", svg, caption, [("NIS", 0), ("95 % of chi-square", 7)])]


def nis_band(freedom: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return both bounds of 95 % of chi-square for each number of degrees of freedom; NaN for 0."""
    known, place = np.unique(freedom, return_inverse=True)
    bounds = [chi2.ppf([0.025, 0.975], dof) if dof > 0 else (np.nan, np.nan) for dof in known]
    low, high = np.array(bounds)[place].T
    return low, high


def matching(run: RunRecord) -> list[str]:
    """Return how the scans matched the map."""
    if not run.scans:
        return []
    x, marks = run.seconds, _failed_at(run, run.seconds)
    counts = [Line(x, run.scans["matches"], 0), Line(x, run.scans["points"], 7)]
    scans = [("points matched", 0), ("points of the scan", 7)]
    residual = line_chart([Line(x, run.scans["rmse"], 0)], _TIME, "residual [m]", marks=marks, from_zero=True)
    rounds = [Line(x, run.scans["iterations"], 0), Line(x, run.scans["unobserved"], 1)]
    names = [("iterations", 0), ("directions not observed, of 6", 1)]
    return [
        figure("Matches", line_chart(counts, _TIME, "points", marks=marks, log=True), legend=scans),
        figure("Residual of the match", residual, "Robustly weighted rms distance to the map."),
        figure("Solve", line_chart(rounds, _TIME, "count", marks=marks, from_zero=True), legend=names),
        figure("Speed", line_chart([Line(x, _speed(run), 0)], _TIME, "speed [m/s]", from_zero=True)),
    ]


def times(run: RunRecord) -> list[str]:
    """Return the figures of each scan's time by stage."""
    stages = {
        name: run.scans[f"{name}_ms"] for name in ("pad", "step", "record") if f"{name}_ms" in run.scans
    }
    if not stages:
        return []
    stack = stack_chart(stages, run.scans["scan"], "scan", "time [ms]")
    boxes = {name.removesuffix("_ms"): run.scans[name] for name in run.scans if name.endswith("_ms")}
    legend = [(name, number) for number, name in enumerate(stages)]
    return [
        figure(
            "Time of each scan", stack, "Cut off at the 99th percentile; decoding runs in parallel.", legend
        ),
        figure("Time by stage", box_chart(boxes, "time [ms]"), "Box: quartiles, whiskers: 5 and 95 %."),
    ]


def _speed(run: RunRecord) -> NDArray[np.float64]:
    return np.linalg.norm(run.states["velocity"], axis=1)


def _failed_at(run: RunRecord, x: NDArray[np.float64]) -> list[float]:
    return x[run.scans["failed"]].tolist() if "failed" in run.scans else []


def way_of(run: RunRecord, part: Trajectory) -> NDArray[np.float64]:
    """Return the distance travelled, m, at the poses of a part of the run's trajectory."""
    return run.distance[np.searchsorted(run.trajectory.stamp_ns, part.stamp_ns)]
