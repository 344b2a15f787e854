"""Find inertial samples that do not measure the motion: spikes, stuck axes, blocks that are sent again."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.sequence import ImuData

_SPIKE_LENGTH = 2
"""Largest number of consecutive samples of a spike: a shock lasts longer, and is real."""
_SPIKE_FACTOR = 20.0
"""A spike is so many times as far from the median of its neighbours as nine of ten samples around it."""
_LEAST_TURN, _LEAST_CHANGE = 5e-4, 0.01
"""Smaller spikes do no harm: their change of attitude, rad, and of velocity, m/s, over one interval."""
_MOST_SPIKES = 0.05
"""Where a larger share of the samples stands out, that is the signal."""
_BLOCK = 100
"""Number of samples that tell what is usual."""
_STUCK_S, _STUCK_SAMPLES = 0.2, 20
"""An axis that keeps one value for so long, s, and for so many samples, is stuck."""
_EQUAL_SHARE = 0.3
"""Where a larger share of successive values are equal, the resolution is coarse or nothing moves."""
_AGAIN = 5
"""Smallest number of successive samples that repeat earlier ones."""


def unmeasured(imu: ImuData, seconds: NDArray[np.float64]) -> tuple[NDArray[np.bool_], list[str]]:
    """Return which samples do not measure the motion, (m,), and a sentence for each kind of fault.

    Args:
        imu: samples with ascending stamps, rad/s and m/s^2.
        seconds: (m,) their times from the recording's first sample, s.
    """
    bad = np.zeros(len(seconds), bool)
    sentences: list[str] = []
    if len(seconds) < _STUCK_SAMPLES:
        return bad, sentences
    interval = float(np.median(np.diff(seconds)))
    for values, name, unit, least in (
        (imu.gyro, "gyroscope", "rad/s", _LEAST_TURN / interval),
        (imu.accel, "accelerometer", "m/s^2", _LEAST_CHANGE / interval),
    ):
        off = np.abs(values - _neighbours_median(values))
        spiked = _spikes(off, least)
        if spiked.any():
            first = int(np.argmax(spiked))
            axis = int(np.argmax(off[first]))
            sentences.append(
                f"{np.count_nonzero(spiked)} sample(s) of the {name} are spikes, the first at "
                f"{seconds[first]:.3f} s ({values[first, axis]:.4g} {unit} along {'xyz'[axis]}): they were "
                "dropped."
            )
            bad |= spiked
        held = list(_stuck(values, max(_STUCK_SAMPLES, round(_STUCK_S / interval))))
        sentences += _on_stuck(held, values, seconds, name, unit)
        for _, part, _ in held:
            bad[part] = True
    again = _sent_again(imu) & ~bad
    if again.any():
        sentences.append(
            f"{np.count_nonzero(again)} sample(s) repeat the values of an earlier block, the first at "
            f"{seconds[int(np.argmax(again))]:.3f} s: they were dropped."
        )
    return bad | again, sentences


def _on_stuck(
    held: list[tuple[int, slice, bool]],
    values: NDArray[np.float64],
    seconds: NDArray[np.float64],
    name: str,
    unit: str,
) -> list[str]:
    """Return a sentence for each time in which an axis is stuck, and for each axis that is saturated."""
    sentences = []
    for axis, part, saturated in held:
        if saturated:
            continue
        end = "the end" if part.stop == len(seconds) else f"{seconds[part.stop]:.3f} s"
        sentences.append(
            f"the {name}'s {'xyz'[axis]} axis is stuck at {values[part.start, axis]:.4g} {unit} from "
            f"{seconds[part.start]:.3f} s to {end} while the others move: these {part.stop - part.start} "
            "samples were dropped."
        )
    for axis in range(3):
        parts = [part for one, part, saturated in held if saturated and one == axis]
        if not parts:
            continue
        limits = sorted({float(values[part.start, axis]) for part in parts})
        sentences.append(
            f"the {name}'s {'xyz'[axis]} axis stays at {' and '.join(f'{one:.4g}' for one in limits)} {unit} "
            f"for {sum(part.stop - part.start for part in parts)} samples, the first at "
            f"{seconds[parts[0].start]:.3f} s: it is saturated, and these samples were dropped; use a larger "
            "measuring range."
        )
    return sentences


def _neighbours_median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of each value and its three neighbours on either side, (m, 3)."""
    extended = np.pad(values, ((3, 3), (0, 0)), mode="edge")
    median: NDArray[np.float64] = np.median(
        np.lib.stride_tricks.sliding_window_view(extended, 7, axis=0), axis=-1
    )
    return median


def _spikes(off: NDArray[np.float64], least: float) -> NDArray[np.bool_]:
    """Return which samples are spikes.

    Args:
        off: (m, 3) distance of each value from the median of its neighbours.
        least: smallest distance of a spike.
    """
    starts = np.arange(0, len(off), _BLOCK)
    usual = np.stack([np.quantile(off[start : start + _BLOCK], 0.9, axis=0) for start in starts])
    # the blocks beside count, too: a vehicle may start to move in the middle of one
    beside = np.pad(usual, ((1, 1), (0, 0)), mode="edge")
    usual = np.max([beside[:-2], usual, beside[2:]], axis=0)
    outlying = (off > np.maximum(least, _SPIKE_FACTOR * usual[np.arange(len(off)) // _BLOCK])).any(axis=1)
    spiked = np.zeros(len(off), bool)
    for run in _runs(outlying):
        spiked[run] = run.stop - run.start <= _SPIKE_LENGTH
    return spiked if spiked.mean() <= _MOST_SPIKES else np.zeros(len(off), bool)


def _stuck(values: NDArray[np.float64], least: int) -> Iterator[tuple[int, slice, bool]]:
    """Yield axis and samples of each time in which one axis keeps its value while the others change.

    The flag says whether the value is the end of the axis's range: the axis is saturated.

    Args:
        values: (m, 3).
        least: smallest number of samples.
    """
    equal = np.diff(values, axis=0) == 0
    for axis in range(3):
        held = [slice(run.start, run.stop + 1) for run in _runs(equal[:, axis])]
        held = [part for part in held if part.stop - part.start >= least]
        if not held:
            continue
        elsewhere = np.ones(len(values), bool)
        for part in held:
            elsewhere[part] = False
        moves = elsewhere[1:] & elsewhere[:-1]
        if moves.any() and equal[moves, axis].mean() > _EQUAL_SHARE:
            continue
        ends = values[:, axis].min(), values[:, axis].max()
        others = [other for other in range(3) if other != axis]
        for part in held:
            value = values[part.start, axis]
            saturated = value in ends and abs(value) > max(np.abs(ends)) / 2 and bool(elsewhere.any())
            still = equal[part.start : part.stop - 1][:, others].mean(axis=0) > _EQUAL_SHARE
            if not still.any() and all(_is_noisy(values[part, other]) for other in others):
                yield axis, part, saturated


def _is_noisy(values: NDArray[np.float64]) -> bool:
    """Return whether values scatter as a sensor's do: those of a noise-free simulator change smoothly."""
    bend = np.diff(values, 2)
    return float(np.sum(bend[1:] * bend[:-1])) < 0


def _sent_again(imu: ImuData) -> NDArray[np.bool_]:
    """Return which samples repeat, value by value, a block of earlier ones."""
    rows = np.ascontiguousarray(np.concatenate([imu.gyro, imu.accel], axis=1))
    _, number = np.unique(rows.view(np.dtype((np.void, rows.itemsize * 6))).ravel(), return_inverse=True)
    order = np.argsort(number, kind="stable")
    earlier = np.full(len(rows), -1)
    earlier[order[1:]] = np.where(number[order[1:]] == number[order[:-1]], order[:-1], -1)
    lag = np.where(earlier >= 0, np.arange(len(rows)) - earlier, 0)
    again = np.zeros(len(rows), bool)
    # a value that is held for some samples is no block: a lag of one
    for run in _runs((lag[1:] == lag[:-1]) & (lag[1:] > 1)):
        part = slice(run.start, run.stop + 1)
        again[part] = len(np.unique(number[part])) >= _AGAIN
    return again


def _runs(flags: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the parts in which all flags are set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    for start, stop in edges.reshape(-1, 2).tolist():
        yield slice(start, stop)
