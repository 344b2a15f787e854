"""The KITTI odometry benchmark's error: relative drift over path segments of fixed lengths."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BENCHMARK_LENGTHS_M = tuple(float(length) for length in range(100, 801, 100))
BENCHMARK_STEP = 10
SHORT_LENGTHS_M = tuple(float(length) for length in range(10, 81, 10))
SHORT_STEP = 1


@dataclass(frozen=True)
class SegmentErrors:
    """Drift per travelled metre, averaged over all segments of all lengths."""

    translation_percent: float
    """Translation error over segment length, %."""
    rotation_deg_per_m: float
    """Rotation error over segment length, deg/m."""
    segments: int
    """Number of segments averaged."""


def kitti_errors(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> SegmentErrors | None:
    """Return the benchmark's drift: segments of 100, 200, ... 800 m that start at every 10th frame.

    Takes the arguments of :func:`segment_errors`. Returns None where the path is too short for any segment.
    """
    return segment_errors(estimate, reference, BENCHMARK_LENGTHS_M, BENCHMARK_STEP)


def kitti_short_errors(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> SegmentErrors | None:
    """Return the drift over 10, 20, ... 80 m from every frame, for short runs: NOT the benchmark's number."""
    return segment_errors(estimate, reference, SHORT_LENGTHS_M, SHORT_STEP)


def segment_errors(
    estimate: NDArray[np.float64],
    reference: NDArray[np.float64],
    lengths_m: tuple[float, ...],
    step: int,
) -> SegmentErrors | None:
    """Average the relative pose error over all segments, divided by the segment's nominal length.

    A segment starts at every ``step``-th frame. It ends at the first frame whose path distance along the
    reference exceeds the start's by more than the length, as in the benchmark's ``evaluate_odometry.cpp``.

    Args:
        estimate: (n, 4, 4) T_world_body.
        reference: (n, 4, 4), poses of the same body frame at the same instants; the worlds may differ.
        lengths_m: segment lengths, m.
        step: number of frames between two starts.
    """
    starts = np.arange(0, len(reference), step)
    lengths = np.asarray(lengths_m, np.float64)
    ends = segment_ends(reference, starts, lengths)
    start_row, length_column = np.nonzero(ends < len(reference))
    if start_row.size == 0:
        return None
    length = lengths[length_column]
    translation, angle = relative_errors(
        estimate, reference, starts[start_row], ends[start_row, length_column]
    )
    return SegmentErrors(
        translation_percent=float(100.0 * np.mean(translation / length)),
        rotation_deg_per_m=float(np.mean(np.degrees(angle) / length)),
        segments=int(start_row.size),
    )


def segment_ends(
    reference: NDArray[np.float64], starts: NDArray[np.int64], lengths_m: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return (s, l) the frames at which segments of given lengths end; n where the path is too short.

    Args:
        reference: (n, 4, 4) poses, m.
        starts: (s,) frames at which segments start.
        lengths_m: (l,) lengths along the reference, m.
    """
    steps = np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    return np.searchsorted(travelled, travelled[starts][:, None] + lengths_m, side="right")


def relative_errors(
    estimate: NDArray[np.float64],
    reference: NDArray[np.float64],
    first: NDArray[np.int64],
    last: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the errors of the motion from frames ``first`` to ``last``, (p,) m and (p,) rad.

    Args:
        estimate: (n, 4, 4) T_world_body.
        reference: (n, 4, 4), poses of the same body frame at the same instants; the worlds may differ.
        first: (p,) frames at which the pairs start.
        last: (p,) frames at which the pairs end.
    """
    # True inverses, not transposes: published truth is rounded text and not exactly orthonormal.
    inverse_estimate, inverse_reference = np.linalg.inv(estimate), np.linalg.inv(reference)
    error = (inverse_estimate[last] @ estimate[first]) @ (inverse_reference[first] @ reference[last])
    # The benchmark takes arccos of the trace, which near zero turns 1e-7 of rounding into 5e-4 rad; the chord
    # gives the same angle without this loss.
    chord = np.linalg.norm(error[:, :3, :3] - np.eye(3), axis=(1, 2))
    angle = 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))
    return np.linalg.norm(error[:, :3, 3], axis=1), angle
