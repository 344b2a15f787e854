"""GPS messages become local positions; what is no fix is left out."""

import numpy as np

from lio_jax.data.navigation_messages import GpsCollector
from tests.data import bags


def test_fixes_are_local_to_the_first_valid_one() -> None:
    collector = GpsCollector()
    collector.add(bags.fix_message(1, 0.0, 0.0))
    collector.add(bags.fix_message(2, 49.0, 8.0, status=-1))
    collector.add(bags.fix_message(3, float("nan"), 8.0))
    collector.add(bags.fix_message(4, 49.0, 8.0, 110.0))
    collector.add(bags.fix_message(5, 49.001, 8.0, 112.0, variance=0.25))
    gps, notes = collector.gps()
    assert gps is not None
    assert gps.stamp_ns.tolist() == [4, 5]
    assert gps.origin == (49.0, 8.0, 110.0)
    # One thousandth of a degree of latitude at 49 deg north is 111.21 m.
    np.testing.assert_allclose(gps.position, [[0, 0, 0], [0, 111.21, 2.0]], atol=0.01)
    np.testing.assert_array_equal(gps.covariance, [np.eye(3) * 4.0, np.eye(3) * 0.25])
    assert notes == ("GPS: 3 messages without a valid fix were left out",)


def test_a_missing_covariance_is_assumed_and_reported() -> None:
    collector = GpsCollector()
    collector.add(bags.fix_message(4, 49.0, 8.0, variance=0.0))
    gps, notes = collector.gps()
    assert gps is not None
    np.testing.assert_array_equal(gps.covariance[0], np.diag([25.0, 25.0, 100.0]))
    assert notes == (
        "GPS: 1 of 1 fixes state no covariance: 5 m horizontally and 10 m vertically were assumed",
    )


def test_odometry_is_taken_as_it_is_in_time_order() -> None:
    collector = GpsCollector()
    collector.add(bags.odometry_message(20, (4.0, 5.0, 6.0)))
    collector.add(bags.odometry_message(10, (0.0, 0.0, 0.0)))
    gps, notes = collector.gps()
    assert gps is not None
    assert gps.stamp_ns.tolist() == [10, 20]
    np.testing.assert_array_equal(gps.position, [[0, 0, 0], [4, 5, 6]])
    np.testing.assert_array_equal(gps.covariance[0], np.diag([0.5, 0.5, 2.0]))
    assert np.isnan(gps.origin).all()
    assert notes == ("GPS: stamps step back 1 time(s); the fixes were put in order by their stamps",)


def test_where_the_receiver_was_made_is_no_part_of_the_drive() -> None:
    """The frame is level where the drive is, not where the first messages place it."""
    collector = GpsCollector()
    collector.add(bags.fix_message(1, 31.2, 121.4))
    for number in range(5):
        collector.add(bags.fix_message(2 + number, 49.0 + 1e-4 * number, 8.0))
    gps, notes = collector.gps()
    assert gps is not None
    assert gps.stamp_ns.tolist() == [2, 3, 4, 5, 6]
    assert gps.origin == (49.0, 8.0, 100.0)
    assert notes == ("GPS: 1 fixes more than 200 km from the others were left out",)


def test_no_fix_at_all_is_no_gps() -> None:
    collector = GpsCollector()
    collector.add(bags.fix_message(1, 0.0, 0.0))
    assert collector.gps()[0] is None
