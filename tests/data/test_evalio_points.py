"""evalio's points as arrays: copied from its memory, or one by one where its memory is not as expected."""

import numpy as np
import pytest

from lio_jax.data import evalio_points
from lio_jax.data.evalio_points import points_can_be_copied, points_of, points_one_by_one, scan_of

types = pytest.importorskip("evalio.types", reason="evalio is not installed; it comes with lio-jax[dev]")

ROWS, COLUMNS, PERIOD_NS = 3, 4, 100_000_000


def measurement(rows=ROWS, columns=COLUMNS, missing=()):
    """Return a measurement row by row, as evalio keeps it; a missing return is at the origin."""
    points = []
    for row in range(rows):
        for column in range(columns):
            there = (row, column) not in missing
            since = types.Duration.from_nsec(column * PERIOD_NS // columns)
            x, y, z = (1.0 + row, 2.0 + column, -0.5) if there else (0.0, 0.0, 0.0)
            points.append(
                types.Point(x=x, y=y, z=z, intensity=10.0 * row, t=since, range=7, row=row, col=column)
            )
    return types.LidarMeasurement(types.Stamp.from_nsec(1_700_000_000_000_000_001), points)


def test_copied_points_are_those_of_the_accessors():
    large = measurement(16, 300, missing={(0, 0), (5, 7)})
    assert points_can_be_copied(large)
    for name in ("x", "y", "z", "intensity", "t", "range", "row", "col"):
        np.testing.assert_array_equal(points_of(large)[name], points_one_by_one(large)[name])


def test_a_copy_stays_when_the_measurement_is_gone():
    first = measurement()
    copied = points_of(first)
    expected = points_one_by_one(first)
    first.points = []
    del first
    np.testing.assert_array_equal(copied["y"], expected["y"])


@pytest.mark.parametrize("count", [0, 1])
def test_few_points(count):
    few = types.LidarMeasurement(types.Stamp.from_nsec(5), [types.Point(x=1.0)] * count)
    assert len(points_of(few)) == count
    assert len(scan_of(few, 10.0).points) == count


@pytest.mark.parametrize("layout", [None, evalio_points._Layout(7, 0, 4)])
def test_another_layout_is_read_one_by_one(layout, monkeypatch):
    monkeypatch.setattr(evalio_points, "_layout", lambda: layout)
    assert not points_can_be_copied(measurement())
    np.testing.assert_array_equal(points_of(measurement())["x"], np.repeat([1.0, 2.0, 3.0], COLUMNS))


def test_the_layout_is_refused_where_known_points_do_not_come_back(monkeypatch):
    def wrong(measurement):
        return points_one_by_one(measurement)[::-1]

    monkeypatch.setattr(evalio_points, "points_one_by_one", wrong)
    assert evalio_points._layout.__wrapped__() is None


def test_a_scan_has_the_returns_column_by_column():
    scan = scan_of(measurement(missing={(1, 0), (2, 3)}), rate=10.0)
    assert scan.stamp_ns == 1_700_000_000_000_000_001
    assert scan.duration == 0.1
    assert scan.dropped == 2
    np.testing.assert_array_equal(scan.ring, [0, 2, 0, 1, 2, 0, 1, 2, 0, 1])
    np.testing.assert_array_equal(scan.points[:3], np.float32([[1, 2, -0.5], [3, 2, -0.5], [1, 3, -0.5]]))
    np.testing.assert_allclose(scan.time, np.repeat([0, 0.025, 0.05, 0.075], [2, 3, 3, 2]), atol=1e-9)
    np.testing.assert_array_equal(scan.intensity, 10.0 * scan.ring)


def test_a_scan_lasts_until_its_last_firing_if_the_rate_is_too_high():
    assert scan_of(measurement(), rate=20.0).duration == pytest.approx(0.075)


def test_points_of_one_time_make_a_scan_without_duration():
    still = [types.Point(x=1.0, y=float(k)) for k in range(5)]
    scan = scan_of(types.LidarMeasurement(types.Stamp.from_nsec(5), still), rate=10.0)
    assert scan.duration == 0.0
