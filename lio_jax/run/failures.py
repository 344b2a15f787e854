"""Describe what went wrong with a scan in one sentence, and which directions are not observable from it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, NOT_FINITE, ImuBatch
from lio_jax.imu.sampling import LONGEST_GAP
from lio_jax.settings.settings import Settings

_NAMED = 0.8
"""Share of an axis that must be in the unobserved space for its name to be used."""
_MOVING = 0.5
"""Speed below which the direction of motion is not known, m/s."""


def unobserved_directions(registration: Any, nav: Any) -> list[str]:
    """Return words for the degenerate directions of a scan match, one for each.

    Horizontal directions are named relative to the direction of motion, at rest relative to the IMU's x axis;
    the vertical is the world's z. A direction near none of these axes is given by its components.

    Args:
        registration: scan match with its degenerate directions, about which it holds no or little
            information.
        nav: navigation state at the scan's end.
    """
    weak = weak_directions(registration)
    missing = weak.shape[1]

    heading, name = _heading(nav)
    axes = np.stack([heading, np.cross([0.0, 0.0, 1.0], heading), [0.0, 0.0, 1.0]])
    named: list[str] = []
    for row, words in (
        (3, (f"along {name}", f"across {name}", "along the vertical")),
        (0, ("in roll", "in pitch", "in yaw")),
    ):
        for axis, word in zip(axes, words, strict=True):
            within = weak[row : row + 3].T @ axis
            if len(named) < missing and within @ within > _NAMED:
                named.append(word)
                weak = _without(weak, np.concatenate([axis * (row == 0), axis * (row == 3)]))
    return named + [_components(vector) for vector in weak.T[: missing - len(named)]]


def weak_directions(registration: Any) -> NDArray[np.float64]:
    """Return the (6, k) directions that a scan match does not observe, rotation first, world axes.

    Rotations are scaled to metres at a typical point, so that all six directions are comparable. Where the
    match holds no usable information, the directions are the axes.
    """
    missing = int(np.sum(registration.degenerate))
    R_world_lidar = Rotation.from_quat(
        np.asarray(registration.T_world_lidar.wxyz_xyz)[:4], scalar_first=True
    ).as_matrix()
    to_world = np.kron(np.eye(2), R_world_lidar)
    information = np.asarray(registration.information, np.float64)
    by_turn, by_move = np.trace(information[:3, :3]), np.trace(information[3:, 3:])
    if not np.isfinite([*information.ravel(), *to_world.ravel()]).all() or min(by_turn, by_move) <= 0:
        return np.eye(6)[:, :missing]
    scale = np.repeat([1 / (np.sqrt(by_turn / by_move) + 1e-6), 1.0], 3)
    _, vectors = np.linalg.eigh(scale[:, None] * (to_world @ information @ to_world.T) * scale)
    return vectors[:, :missing]


def _heading(nav: Any) -> tuple[NDArray[np.float64], str]:
    """Return a horizontal unit vector, (3,), world frame, and its name."""
    wxyz = np.asarray(nav.T_world_imu.wxyz_xyz, np.float64)[:4]
    moving = np.asarray(nav.velocity, np.float64) * [1, 1, 0]
    x_axis = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()[:, 0] * [1, 1, 0]
    for vector, least, name in ((moving, _MOVING, "the motion"), (x_axis, 0.1, "the IMU's x axis")):
        if (length := np.linalg.norm(vector)) > least:
            return vector / length, name
    return np.array([1.0, 0.0, 0.0]), "the world's x axis"


def _without(weak: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the basis (6, k) of the rest of a space after its part along ``direction`` is removed."""
    along = weak.T @ direction
    along /= np.linalg.norm(along)
    rest, _, _ = np.linalg.svd(np.eye(len(along)) - np.outer(along, along))
    return weak @ rest[:, : len(along) - 1]


def _components(vector: NDArray[np.float64]) -> str:
    turn, move = vector[:3], vector[3:]
    kind, part = ("along", move) if np.linalg.norm(move) > np.linalg.norm(turn) else ("turning about", turn)
    # both signs mean the same direction; the addition of zero turns a rounded -0.0 into 0.0
    unit = part / np.linalg.norm(part) * np.sign(part[np.argmax(np.abs(part))])
    x, y, z = np.round(unit, 2) + 0.0
    return f"{kind} ({x:.2f}, {y:.2f}, {z:.2f}) in world"


_UNLIKELY_NIS = 22.46
"""Bound that a consistent filter exceeds once in 1000 scans: chi-square with six degrees of freedom."""


@dataclass(frozen=True)
class ScanEvidence:
    """The results for one scan from which failures are found, on the host."""

    points: int
    """Number of points of the scan as it was recorded."""
    covered: bool
    """Whether something covers the sensor."""
    nav: Any
    """Navigation state, numpy leaves."""
    registration: Any
    """The scan match, numpy leaves."""
    lost: bool
    """Whether the pose is the prediction."""
    nis: float
    """Normalised innovation squared of the match; 0 without a match."""
    since_last_s: float
    """Time from the last scan's end to this scan's end, s; 0 for the first scan."""
    imu_gap_s: float | None
    """Longest time without an inertial sample since the last scan's end, s; None if no samples are used."""
    features: tuple[int, int] | None = None
    """Number of corners and surface points where they are too few for a match; None where they are not."""
    new_piece: bool = False
    """A new piece of map begins with the scan."""
    restarted: bool = False
    """The smoother ran away and began anew."""
    smoother_unfinished: bool = False
    """The smoother reached its largest number of linearisations."""


def failure_of(now: ScanEvidence, before: ScanEvidence | None, settings: Settings) -> str:
    """Return one sentence for each thing that went wrong with a scan, or "".

    A speed or a bias beyond ``params.limits`` is reported once, when it passes the limit (LIO-SAM's
    failureDetection), with the most likely cause.

    Args:
        now: evidence of the scan.
        before: evidence of the scan before, if any.
        settings: settings of the run.
    """
    limits = settings.values["limits"]
    sentences = [_match_failure(now, settings)]
    if now.restarted:
        sentences.append(
            "the smoother's velocity or biases ran beyond params.limits or were not finite; "
            f"it started again at rest: {_cause(now)}."
        )
    if now.since_last_s > limits["outage"]:
        by = "constant velocity" if _gap(now) > LONGEST_GAP or now.imu_gap_s is None else "inertial samples"
        sentences.append(f"no scan came for {now.since_last_s:.2f} s before it: {by} predicted the motion.")
    for what, value, earlier, limit in _limited(now, before, limits):
        if value > limits[limit] >= earlier:
            sentences.append(
                f"{what[0]} {value:.3g} {what[1]}, above params.limits.{limit}={limits[limit]:g}: "
                f"{_cause(now)}."
            )
    first, *more = [sentence for sentence in sentences if sentence] or [""]
    return " ".join([first, *(sentence[0].upper() + sentence[1:] for sentence in more)])


def only_leaves_open(output: Any) -> bool:
    """Return whether a scan was matched and leaves directions open, along which its pose is the prediction.

    The covariance of the estimator contains the error along them.

    Args:
        output: of the scan's step.
    """
    found = output.registration
    matched = not bool(output.lost) and int(found.status) == CONVERGED
    restarted = output.restarted is not None and bool(output.restarted)
    return matched and not restarted and bool(np.any(np.asarray(found.degenerate)))


def longest_gap(samples: ImuBatch, start: float, end: float) -> float:
    """Return the longest time without a sample that overlaps an interval, s.

    Args:
        samples: samples in the interval and their neighbours, numpy leaves.
        start: start of the interval, s, on the samples' clock.
        end: end of the interval, s, on the samples' clock.
    """
    times = np.asarray(samples.time)[np.asarray(samples.mask)]
    if not len(times):
        return end - start
    within = np.concatenate([[min(start, times[0])], times, [max(end, times[-1])]])
    inner = (within[1:] > start) & (within[:-1] < end)
    return float(np.max(np.diff(within)[inner], initial=0.0))


_SPEEDS_UP = 1.0
"""Acceleration of a body that nothing measures, m/s^2."""
_LARGEST = 3.0
"""Largest error, in standard deviations."""


@dataclass(frozen=True)
class BridgedOutage:
    """The time without a match before a new piece of map, and the possible error of that piece's pose."""

    duration: float
    """Time since the last scan that was matched, s."""
    covariance: NDArray[np.float64] | None
    """(6, 6) covariance of the pose's right perturbation, rotation (rad) before translation (m); None where
    the recipe has none, or none that is finite."""
    position: float
    """Largest error of the position, m."""
    heading: float
    """Largest error of the heading, rad."""


class OutageWatch:
    """Notes when scans were matched, and returns the outage where a new piece of map begins."""

    def __init__(self) -> None:
        self._matched_ns: int | None = None
        self._speed = 0.0

    def __call__(self, stamp_ns: int, now: ScanEvidence, covariance: Any) -> BridgedOutage | None:
        """Return the outage that ends with a scan; None for all other scans.

        Args:
            stamp_ns: the scan's end, ns.
            now: evidence of the scan.
            covariance: (24, 24) covariance of the navigation state; None where the recipe has none.
        """
        ended = None
        if now.new_piece:
            since = stamp_ns if self._matched_ns is None else self._matched_ns
            ended = _outage((stamp_ns - since) * 1e-9, self._speed, covariance)
        if now.new_piece or not now.lost:
            self._matched_ns = stamp_ns
            self._speed = float(np.linalg.norm(now.nav.velocity))
        return ended


def largest_sigma(covariance: NDArray[np.float64]) -> float:
    """Return the largest standard deviation over all directions of a (3, 3) covariance."""
    known = bool(np.isfinite(covariance).all())
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0))) if known else np.inf


def _outage(duration: float, speed: float, covariance: Any) -> BridgedOutage:
    if covariance is None or not np.isfinite(covariance).all():
        return BridgedOutage(duration, None, speed * duration + _SPEEDS_UP / 2 * duration**2, np.pi)
    pose = np.array(covariance, np.float64)[:6, :6]
    position, rotation = (_LARGEST * largest_sigma(block) for block in (pose[3:, 3:], pose[:3, :3]))
    return BridgedOutage(duration, pose, position, min(rotation, np.pi))


def _match_failure(now: ScanEvidence, settings: Settings) -> str:
    found = now.registration
    if now.points == 0:
        return "it holds no points; the pose is the prediction."
    if now.covered:
        return "nearly all its points are within 1 m: the sensor is covered; the pose is the prediction."
    if found.status == NOT_FINITE:
        return (
            f"the update was not finite ({_not_finite(found)}); state and covariance are the prediction's, "
            "the map was not changed."
        )
    if now.lost and now.features:
        least = settings.values["submap"]
        return (
            f"it has {now.features[0]} corners and {now.features[1]} surface points, "
            f"{least['min_corners']:g} and {least['min_surfaces']:g} are needed "
            "(params.submap.min_corners and min_surfaces); the pose is the prediction."
        )
    if now.lost:
        needed = settings.values["registration"]["min_matches"]
        suspects = _suspects(now)
        why = f" ({', '.join(suspects)})" if suspects else ""
        wanted = (
            f"{needed:g} are needed"
            if found.matches < needed
            else "a quarter of all are needed after an outage"
        )
        end = "; a new piece of map begins there." if now.new_piece else "."
        return f"{int(found.matches)} points matched the map, {wanted}{why}; the pose is the prediction{end}"
    if found.status == ITERATION_LIMIT:
        limit = settings.config.registration.max_iterations
        if now.smoother_unfinished:
            return "the smoother did not converge within its iterations; its last states were kept."
        return f"registration did not converge in {limit} iterations; its last pose was kept."
    # too few matches but not lost: the scan that starts the map
    if found.status == CONVERGED and (weak := int(found.degenerate.sum())):
        words = ", ".join(unobserved_directions(found, now.nav))
        return f"the scene leaves {weak} of 6 directions unobserved ({words}); there the prediction was kept."
    return ""


def _not_finite(found: Any) -> str:
    sums = (found.information, found.rmse)
    if all(np.isfinite(leaf).all() for leaf in sums):
        return "the filter's covariance overflowed"
    return f"the equations of its {int(found.matches)} matches hold NaN or infinity"


def _limited(
    now: ScanEvidence, before: ScanEvidence | None, limits: dict[str, Any]
) -> list[tuple[tuple[str, str], float, float, str]]:
    """Return for each exceeded limit: its words, the value now, the value before, and the limit's name."""
    watched = (
        (("the speed reached", "m/s"), "velocity", "speed"),
        (("the gyroscope's bias reached", "rad/s"), "gyro_bias", "gyro_bias"),
        (("the accelerometer's bias reached", "m/s^2"), "accel_bias", "accel_bias"),
    )
    rows = []
    for words, leaf, limit in watched:
        value = float(np.linalg.norm(getattr(now.nav, leaf)))
        earlier = float(np.linalg.norm(getattr(before.nav, leaf))) if before else 0.0
        rows.append((words, value, earlier, limit))
    return rows


def _cause(now: ScanEvidence) -> str:
    """Return the most likely cause of the estimate's deviation."""
    suspects = _suspects(now) + ["the scan was not matched"] * now.lost
    if suspects:
        return f"likely because {' and '.join(suspects)}"
    return (
        f"no gap, unobserved direction or contradiction (residual {float(now.registration.rmse):.2f} m) "
        "explains it; raise the limit if it is true, else check the IMU's units and axes"
    )


def _suspects(now: ScanEvidence) -> list[str]:
    found = now.registration
    suspects = []
    if _gap(now) > LONGEST_GAP:
        suspects.append(f"there was no inertial sample for {_gap(now):.2f} s")
    if now.lost:
        return suspects
    if found.degenerate.any():
        words = ", ".join(unobserved_directions(found, now.nav))
        suspects.append(f"the scene does not constrain the pose {words}")
    if now.nis > _UNLIKELY_NIS:
        biases: NDArray = np.concatenate([now.nav.gyro_bias, now.nav.accel_bias])
        suspects.append(
            f"the scan contradicts the prediction (NIS {now.nis:.0f}, residual {float(found.rmse):.2f} m, "
            f"biases {np.linalg.norm(biases[:3]):.2g} rad/s and {np.linalg.norm(biases[3:]):.2g} m/s^2)"
        )
    return suspects


def _gap(now: ScanEvidence) -> float:
    return now.imu_gap_s or 0.0
