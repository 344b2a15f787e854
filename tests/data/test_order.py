from itertools import permutations

import pytest

from lio_jax.data.time_order import Stamped, ascending, in_time_order

HOUR = 36_000
"""One hour in tenths of a second, the unit of all times here."""


def kept(*tenths: float) -> tuple[list[float], list[str]]:
    """Return which of the times are kept, and the warnings."""
    warnings: list[str] = []
    recorded = [Stamped(round(time * 1e8), f"scan {n}", time) for n, time in enumerate(tenths)]
    return list(in_time_order(recorded, warnings.append)), warnings


def test_ascending_scans_pass() -> None:
    assert kept(1, 2, 5) == ([1, 2, 5], [])


def test_nothing_and_a_single_scan_pass() -> None:
    assert kept() == ([], [])
    assert kept(7) == ([7], [])


def test_a_duplicate_is_dropped_and_named() -> None:
    times, warnings = kept(1, 2, 2, 3)
    assert times == [1, 2, 3]
    assert warnings == ["scan 2 has the same stamp as scan 1 (0.200000000 s): the duplicate was dropped."]


def test_a_step_back_is_skipped_and_measured() -> None:
    times, warnings = kept(1, 2, 4, 2.5, 3, 5)
    assert times == [1, 2, 4, 5]
    assert [warning.split(": ")[0] for warning in warnings] == [
        "scan 3 (0.250000000 s) is 0.150 s older than scan 2",
        "scan 4 (0.300000000 s) is 0.100 s older than scan 2",
    ]


@pytest.mark.parametrize("wild", [5, 100, 1e7, 9e10])
@pytest.mark.parametrize("place", range(6))
def test_a_single_wild_stamp_goes_alone(wild: float, place: int) -> None:
    times: list[float] = [1, 2, 3, 4, 5, 6]
    good = times.copy()
    times[place] += wild
    del good[place]
    if place == 5 and wild < HOUR:
        good.append(6 + wild)  # nothing behind it tells it from a scan after a gap
    chosen, warnings = kept(*times)
    assert chosen == good
    assert len(warnings) == 6 - len(good)
    assert all(f"scan {place} (" in warning and "a wrong stamp" in warning for warning in warnings)


def test_a_wild_stamp_says_how_far_away_it_is() -> None:
    (warning,) = kept(1, 2, 1000, 3)[1]
    assert warning == (
        "scan 2 (100.000000000 s) is 99.700 s ahead of scan 3 and fits none of its neighbours: "
        "a wrong stamp, skipped."
    )


def test_a_first_stamp_of_zero_before_a_clock_was_set() -> None:
    times, warnings = kept(0, 17e9, 17e9 + 1, 17e9 + 2)
    assert times == [17e9, 17e9 + 1, 17e9 + 2]
    assert "scan 0 (0.000000000 s)" in warnings[0]


@pytest.mark.parametrize("place", range(1, 6))
def test_a_single_stamp_of_zero_goes_alone(place: int) -> None:
    times: list[float] = [100, 101, 102, 103, 104, 105]
    good = times.copy()
    times[place] = 0
    del good[place]
    assert kept(*times)[0] == good


@pytest.mark.parametrize("gap", [5, 50, 5000, 10 * HOUR])
def test_gaps_are_no_wrong_stamps(gap: float) -> None:
    for times in ([1, 2, 3, gap + 4, gap + 5], [1, 2, gap + 3, 2 * gap + 4, 2 * gap + 5]):
        assert kept(*times) == (times, [])


def test_a_gap_before_the_last_scan_is_no_wrong_stamp() -> None:
    assert kept(1, 2, 3, 5000) == ([1, 2, 3, 5000], [])


def test_wild_stamps_apart_from_each_other_go_one_by_one() -> None:
    times, warnings = kept(1, 2, 9e9, 3, 4, 8e9, 5, 6)
    assert times == [1, 2, 3, 4, 5, 6]
    assert len(warnings) == 2


def test_a_duplicate_of_a_wild_stamp() -> None:
    times, warnings = kept(1, 2, 9e9, 9e9, 3, 4)
    assert times == [1, 2, 3, 4]
    assert "duplicate" in warnings[0]
    assert "wrong stamp" in warnings[1]


def test_kept_stamps_ascend_for_any_input() -> None:
    for times in permutations([0, 1, 2, 30, 31, 9e9]):
        chosen, warnings = kept(*times)
        assert chosen == sorted(set(chosen))
        assert len(chosen) + len(warnings) == 6


def test_places_of_ascending_stamps() -> None:
    assert ascending([]) == []
    assert ascending([10, 20, 20, 15, 30, 10**18, 40]) == [0, 1, 4, 6]
