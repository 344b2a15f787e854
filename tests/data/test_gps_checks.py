"""Fixes that cannot be used are left out and reported; the others are unchanged."""

from dataclasses import replace

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.gps_checks import cleaned
from lio_jax.data.sequence import GpsData

SECOND = 1_000_000_000
LOCAL = (float("nan"),) * 3


def fixes(count: int = 10, origin: tuple[float, float, float] = (48.0, 11.0, 500.0)) -> GpsData:
    position = np.arange(count)[:, None] * np.array([1.0, 2.0, 0.1])
    return GpsData(
        np.arange(count) * SECOND, position, np.tile(np.diag([1.0, 2.0, 3.0]), (count, 1, 1)), origin
    )


def test_good_fixes_stay_as_they_are():
    gps, said = cleaned(fixes(), "GPS")
    assert said == ()
    np.testing.assert_array_equal(gps.position, fixes().position)
    np.testing.assert_array_equal(gps.covariance, fixes().covariance)
    assert gps.origin == fixes().origin


def test_an_outage_is_no_fault():
    stamps = np.array([0, 1, 2, 90, 91, 92, 93, 94, 95, 96]) * SECOND
    gps, said = cleaned(replace(fixes(), stamp_ns=stamps), "GPS")
    assert said == ()
    np.testing.assert_array_equal(gps.stamp_ns, stamps)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e9])
def test_impossible_positions(wrong):
    gps = fixes()
    gps.position[3, 1] = wrong
    left, [sentence] = cleaned(gps, "gps.npz")
    assert sentence == "gps.npz: 1 GPS fix(es) without a possible position were left out."
    assert left.stamp_ns.tolist() == [n * SECOND for n in range(10) if n != 3]


def test_a_local_frame_begins_where_the_receiver_has_it():
    """(0, 0) is the origin of an east-north-up frame, and no place in one that is not known yet."""
    assert len(cleaned(fixes(), "GPS")[0].stamp_ns) == 10
    left, [sentence] = cleaned(fixes(origin=LOCAL), "GPS")
    assert "1 GPS fix(es) at (0, 0)" in sentence
    assert len(left.stamp_ns) == 9


def test_stamps_that_run_backwards():
    gps = fixes()
    gps.stamp_ns[5:7] -= 4 * SECOND
    left, [sentence] = cleaned(gps, "GPS")
    assert "2 GPS fix(es) whose stamp repeats, steps back or leaps ahead" in sentence
    assert left.stamp_ns.tolist() == [n * SECOND for n in (0, 1, 2, 3, 4, 7, 8, 9)]
    np.testing.assert_array_equal(left.position, fixes().position[[0, 1, 2, 3, 4, 7, 8, 9]])


NO_COVARIANCE = {
    "zeros": np.zeros((3, 3)),
    "NaN": np.diag([1.0, np.nan, 1.0]),
    "negative": np.diag([-1.0, 1.0, 1.0]),
    "not symmetric": np.eye(3) + np.array([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]]),
    "not positive": np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
}


@pytest.mark.parametrize("case", NO_COVARIANCE)
def test_what_is_no_covariance(case):
    gps = fixes()
    gps.covariance[2] = NO_COVARIANCE[case]
    left, [sentence] = cleaned(gps, "GPS")
    assert "1 of 10 fixes state no covariance: 5 m horizontally and 10 m" in sentence
    np.testing.assert_array_equal(left.covariance[2], np.diag([25.0, 25.0, 100.0]))
    np.testing.assert_array_equal(left.covariance[3], np.diag([1.0, 2.0, 3.0]))


def test_arrays_of_different_length():
    with pytest.raises(LioJaxError, match=r"^gps\.npz: 10 GPS stamps, but positions of shape \(9, 3\)"):
        cleaned(replace(fixes(), position=fixes().position[:9]), "gps.npz")


def test_no_fix_is_left():
    gps = fixes(3)
    gps.position[:] = np.nan
    left, [_] = cleaned(gps, "GPS")
    assert len(left.stamp_ns) == 0
    assert left.covariance.shape == (0, 3, 3)
