"""Find the reference pose that belongs to each estimated pose."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.timestamps import ns_to_seconds
from lio_jax.data.trajectory import Trajectory

# Text files round stamps (KITTI's times.txt has 6 digits): this close to the span's end counts as its end.
_SPAN_TOLERANCE_NS = 100_000
# Interpolation over a longer hole in the reference would invent truth.
_GAP_SECONDS = 1.0
_GAP_MEDIAN_PERIODS = 5.0
# A diverged filter's positions overflow when squared: a position beyond this counts as not finite.
_FARTHEST_M = 1e9


@dataclass(frozen=True)
class MatchedTrajectories:
    """Estimate and reference at the same instants, with one reference pose for each estimated pose."""

    estimate: Trajectory
    reference: Trajectory
    notes: tuple[str, ...]
    """One sentence for each group of poses that was left out or was paired by assumption."""

    def __len__(self) -> int:
        return len(self.estimate)


def match_by_time(
    estimate: Trajectory,
    reference: Trajectory,
    estimate_name: str = "the estimate",
    reference_name: str = "the reference",
) -> MatchedTrajectories:
    """Interpolate the reference at those stamps of the estimate that have reference poses on both sides.

    A pose is left out if it is outside the reference's span, in a hole of the reference (longer than 1 s and
    than 5 of its median periods), or not finite. ``notes`` counts these poses.

    Raises:
        LioJaxError: nothing is left to compare; the sentence names both time spans.
    """
    estimate, notes = _finite(estimate, estimate_name)
    reference, reference_notes = _finite(reference, reference_name)
    notes += reference_notes
    first, last = reference.stamp_ns[0], reference.stamp_ns[-1]
    stamps = estimate.stamp_ns
    inside = (stamps >= first - _SPAN_TOLERANCE_NS) & (stamps <= last + _SPAN_TOLERANCE_NS)
    if not inside.any():
        raise LioJaxError(
            f"No pose of {estimate_name} lies in the time span of {reference_name}: "
            f"{span(estimate.stamp_ns)} against {span(reference.stamp_ns)}; both must come from the same "
            "recording and clock."
        )
    if not inside.all():
        left_out = f"{int((~inside).sum())} of {len(stamps)} estimated poses"
        notes += (f"{left_out} lie outside the reference's time span and are not compared.",)
    holes = inside & in_gap(stamps, reference.stamp_ns)
    if holes.any():
        notes += (f"{int(holes.sum())} estimated poses lie in holes of the reference and are not compared.",)
    keep = inside & ~holes
    if not keep.any():
        raise LioJaxError(
            f"Every pose of {estimate_name} within the span of {reference_name} lies in a hole of it "
            f"(longer than {_GAP_SECONDS:g} s); use a denser reference."
        )
    matched_reference = reference.at(np.clip(stamps[keep], first, last))
    return MatchedTrajectories(Trajectory(stamps[keep], estimate.poses[keep]), matched_reference, notes)


def match_by_index(
    estimate: Trajectory,
    reference: Trajectory,
    estimate_name: str = "the estimate",
    reference_name: str = "the reference",
) -> MatchedTrajectories:
    """Pair the poses by their index, for files without stamps.

    Raises:
        LioJaxError: the lengths differ, or no pair is finite.
    """
    if len(estimate) != len(reference):
        raise LioJaxError(
            f"{estimate_name} holds {len(estimate)} poses and {reference_name} {len(reference)}, and without "
            "stamps they can only be paired one to one; give trajectories with stamps (TUM), put a times.txt "
            "into the KITTI pose file's folder, or cut both to the same scans."
        )
    finite = _finite_rows(estimate) & _finite_rows(reference)
    notes: tuple[str, ...] = ("Poses were paired by their index, because there are no stamps to match by.",)
    if not finite.any():
        raise LioJaxError(f"{estimate_name} and {reference_name} share no pose that is finite in both.")
    if not finite.all():
        notes += (f"{int((~finite).sum())} poses are not finite and are not compared.",)
    return MatchedTrajectories(
        Trajectory(estimate.stamp_ns[finite], estimate.poses[finite]),
        Trajectory(reference.stamp_ns[finite], reference.poses[finite]),
        notes,
    )


def in_gap(stamps: NDArray[np.int64], knots: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether each stamp lies in a hole between knots, too long for interpolation, (n,).

    Args:
        stamps: (n,) times, ns.
        knots: (m,) times of poses, ns, ascending.
    """
    if len(knots) < 2:
        return np.zeros(len(stamps), bool)
    periods = np.diff(knots)
    limit_ns = max(_GAP_SECONDS * 1e9, _GAP_MEDIAN_PERIODS * float(np.median(periods)))
    after = np.clip(np.searchsorted(knots, stamps, side="left"), 1, len(knots) - 1)
    on_knot = (stamps == knots[after]) | (stamps <= knots[0]) | (stamps >= knots[-1])
    return (periods[after - 1] > limit_ns) & ~on_knot


def _finite_rows(trajectory: Trajectory) -> NDArray[np.bool_]:
    # The negated comparison also covers NaN and infinity.
    return np.asarray((np.abs(trajectory.poses) < _FARTHEST_M).all(axis=(1, 2)))


def _finite(trajectory: Trajectory, name: str) -> tuple[Trajectory, tuple[str, ...]]:
    finite = _finite_rows(trajectory)
    if not finite.any():
        raise LioJaxError(f"{name} holds no pose with finite numbers; there is nothing to compare.")
    if finite.all():
        return trajectory, ()
    note = f"{int((~finite).sum())} of {len(trajectory)} poses of {name} are not finite and are not compared."
    return Trajectory(trajectory.stamp_ns[finite], trajectory.poses[finite]), (note,)


def span(stamp_ns: NDArray[np.int64]) -> str:
    """Return the first and the last of some stamps (n,) as decimal seconds, for messages."""
    first, last = int(stamp_ns[0]), int(stamp_ns[-1])
    return f"[{ns_to_seconds(first)} .. {ns_to_seconds(last)}] s"
