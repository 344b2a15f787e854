"""Unit, reference and anchor of per-point times recognised from what drivers really write."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lio_jax.data.config import DataConfig
from lio_jax.data.point_time import PointTiming, TimeSample, recognise_point_time, scan_period

STAMP = 1_700_000_000_123_456_789
PERIOD = 100_000_000
SWEEP = 99_000_000
LATE = 8_000_000
AUTO = DataConfig()
FIRINGS_NS = np.linspace(0, SWEEP, 500).round().astype(np.int64)
TICK_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


def _ticks(since_zero_ns: np.ndarray, unit: str, kind: str) -> np.ndarray:
    """Write integer ns in a unit without losing more than the kind itself loses."""
    if np.dtype(kind).kind in "ui":
        return (since_zero_ns // TICK_NS[unit]).astype(kind)
    return (since_zero_ns.astype(np.longdouble) / np.longdouble(TICK_NS[unit])).astype(kind)


def _samples(
    zero_of: Any, unit: str, kind: str, *, header_of: Any, received_of: Any, scans: int = 6
) -> tuple[list[TimeSample], list[np.ndarray]]:
    samples, times = [], []
    for number in range(scans):
        start = STAMP + number * PERIOD
        ticks = _ticks(start + FIRINGS_NS - zero_of(start), unit, kind)
        times.append(ticks)
        samples.append(
            TimeSample(header_of(start), received_of(start), ticks.min().item(), ticks.max().item())
        )
    return samples, times


def _starts(timing: PointTiming, samples: list[TimeSample], times: list[np.ndarray]) -> list[int]:
    """Check what holds for every placed scan, and return the starts relative to the true ones."""
    starts = []
    for number, (sample, ticks) in enumerate(zip(samples, times, strict=True)):
        start, seconds, duration = timing.place(sample.header_ns, ticks, sample.low, sample.high)
        assert seconds.dtype == np.float32
        assert seconds.min() >= 0.0
        assert seconds.max() <= np.float32(duration)
        np.testing.assert_allclose(seconds, FIRINGS_NS * 1e-9, atol=2e-6)
        assert duration == pytest.approx(SWEEP * 1e-9, abs=2e-6)
        starts.append(start - (STAMP + number * PERIOD))
    return starts


@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        ("s", "f4"),
        ("s", "f8"),
        ("ms", "f4"),
        ("us", "f4"),
        ("us", "u4"),
        ("ns", "u4"),
        ("ns", "f4"),
        ("ns", "i4"),
        ("ns", "f8"),
    ],
)
@pytest.mark.parametrize("scans", [1, 6])
def test_relative_times_of_every_unit(unit: str, kind: str, scans: int) -> None:
    samples, times = _samples(
        lambda start: start,
        unit,
        kind,
        header_of=lambda start: start,
        received_of=lambda start: start + SWEEP + LATE,
        scans=scans,
    )
    timing = recognise_point_time(samples, "t", "kind", AUTO)
    assert timing is not None
    assert not timing.absolute
    assert (
        timing.note
        == f"per-point time: field 't', kind {unit} relative, 0.0990 s a scan, header stamp at scan start"
    )
    assert _starts(timing, samples, times) == [0] * scans
    of_a_part = recognise_point_time(samples, "t", "kind", AUTO, called="message")
    assert of_a_part == replace(timing, note=timing.note.replace(" scan", " message"))


@pytest.mark.parametrize(
    ("unit", "kind", "exact_ns"), [("s", "f8", 120), ("us", "f8", 126), ("ns", "f8", 128)]
)
@pytest.mark.parametrize("at", ["start", "end"])
@pytest.mark.parametrize("scans", [1, 6])
def test_absolute_times_place_the_scan_by_themselves(
    unit: str, kind: str, exact_ns: int, at: str, scans: int
) -> None:
    samples, times = _samples(
        lambda start: 0,
        unit,
        kind,
        header_of=lambda start: start + (SWEEP if at == "end" else 0),
        received_of=lambda start: start + SWEEP + LATE,
        scans=scans,
    )
    timing = recognise_point_time(samples, "timestamp", "float64", AUTO)
    assert timing is not None
    assert timing.note == (
        f"per-point time: field 'timestamp', float64 {unit} absolute, 0.0990 s a scan, "
        f"header stamp at scan {at}"
    )
    assert np.abs(_starts(timing, samples, times)).max() <= exact_ns


def test_absolute_times_of_another_clock_are_anchored_at_the_header() -> None:
    uptime = 4_000_000_000
    samples, times = _samples(
        lambda start: STAMP - uptime,
        "us",
        "u4",
        header_of=lambda start: start,
        received_of=lambda start: start + SWEEP + LATE,
    )
    timing = recognise_point_time(samples, "t", "uint32", AUTO)
    assert timing is not None
    assert timing.absolute
    assert "uint32 us absolute" in timing.note
    assert "another clock than the header" in timing.note
    assert _starts(timing, samples, times) == [0] * 6


def test_negative_times_say_that_the_stamp_is_at_the_end() -> None:
    samples, times = _samples(
        lambda start: start + SWEEP,
        "s",
        "f4",
        header_of=lambda start: start + SWEEP,
        received_of=lambda start: start + SWEEP + LATE,
    )
    timing = recognise_point_time(samples, "time", "float32", AUTO)
    assert timing is not None
    assert "header stamp at scan end (times are negative)" in timing.note
    assert np.abs(_starts(timing, samples, times)).max() < 10


def test_times_of_both_signs_say_that_the_stamp_is_inside() -> None:
    samples, times = _samples(
        lambda start: start + SWEEP // 2,
        "s",
        "f8",
        header_of=lambda start: start + SWEEP // 2,
        received_of=lambda start: start + SWEEP + LATE,
    )
    timing = recognise_point_time(samples, "time", "float64", AUTO)
    assert timing is not None
    assert "0.049 s into the scan" in timing.note or "0.050 s into the scan" in timing.note
    assert np.abs(_starts(timing, samples, times)).max() < 10


def test_receipt_sooner_than_the_scan_lasts_says_that_the_stamp_is_at_the_end() -> None:
    samples, times = _samples(
        lambda start: start,
        "ns",
        "u4",
        header_of=lambda start: start + SWEEP,
        received_of=lambda start: start + SWEEP + LATE,
    )
    timing = recognise_point_time(samples, "t", "uint32", AUTO)
    assert timing is not None
    assert "header stamp at scan end (received 0.008 s after it)" in timing.note
    assert _starts(timing, samples, times) == [0] * 6


@pytest.mark.parametrize("latency", [0, -3_000_000_000, 40_000_000_000_000])
def test_receipt_times_of_another_clock_are_not_used_and_start_is_assumed(latency: int) -> None:
    samples, times = _samples(
        lambda start: start,
        "s",
        "f4",
        header_of=lambda start: start,
        received_of=lambda start: start + latency,
    )
    timing = recognise_point_time(samples, "time", "float32", AUTO)
    assert timing is not None
    assert "header stamp at scan start (assumed; config.data.stamp_at=end otherwise)" in timing.note
    assert _starts(timing, samples, times) == [0] * 6


@pytest.mark.parametrize("zero", ["start", "end"])
@pytest.mark.parametrize("stamp_at", ["start", "end"])
@pytest.mark.parametrize("reference", ["relative", "absolute"])
def test_everything_can_be_overridden(zero: str, stamp_at: Any, reference: Any) -> None:
    epoch = 0 if reference == "absolute" else None
    shift = SWEEP if zero == "end" else 0
    samples, times = _samples(
        lambda start: start + shift if epoch is None else epoch,
        "s",
        "f8",
        header_of=lambda start: start + (SWEEP if stamp_at == "end" else 0),
        received_of=lambda start: start,
    )
    config = replace(AUTO, time_unit="s", time_reference=reference, stamp_at=stamp_at)
    timing = recognise_point_time(samples, "time", "float64", config)
    assert timing is not None
    assert f"header stamp at scan {stamp_at} (config.data.stamp_at)" in timing.note
    assert np.abs(_starts(timing, samples, times)).max() < 300


def test_an_overridden_unit_that_cannot_be_is_pointed_out() -> None:
    samples, _ = _samples(
        lambda start: start, "us", "u4", header_of=lambda start: start, received_of=lambda start: start
    )
    timing = recognise_point_time(samples, "t", "uint32", replace(AUTO, time_unit="ms"))
    assert timing is not None
    assert timing.tick_ns == 1_000_000
    assert "does not fit the 0.1 s between scans, check config.data.time_unit" in timing.note


def test_equal_times_are_no_times() -> None:
    samples = [TimeSample(STAMP + k * PERIOD, STAMP, 0.0, 0.0) for k in range(4)]
    assert recognise_point_time(samples, "time", "float32", AUTO) is None


def test_a_short_scan_keeps_the_zero_of_its_relative_times() -> None:
    timing = PointTiming(1, False, "start", 0.099, "")
    start, seconds, duration = timing.place(
        STAMP, np.array([30_000_000, 60_000_000], np.uint32), 30_000_000, 60_000_000
    )
    assert start == STAMP
    np.testing.assert_allclose(seconds, [0.03, 0.06])
    assert duration == pytest.approx(0.06)


def test_outliers_are_found_only_where_there_are_some() -> None:
    timing = PointTiming(1_000_000_000, True, "points", 0.099, "")
    times = 1.7e9 + np.linspace(0, 0.099, 50)
    assert timing.outliers(times) is None
    times[7] = 0.0
    wrong = timing.outliers(times)
    assert wrong is not None
    assert np.flatnonzero(wrong).tolist() == [7]


def test_the_period_is_the_usual_step_between_stamps_in_any_order() -> None:
    assert scan_period([300, 100, 100, 0, 200, 900], 0.1) == pytest.approx(1e-7)
    assert scan_period([5], 0.1) == 0.1
