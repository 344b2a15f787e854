"""Pushed data give the results of a recording that is read, whatever arrives first."""

import numpy as np
import pytest

from lio_jax.core.xla import forget_programs
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.pushed import PushedOdometry, rehearse
from lio_jax.run.run import imu_feed, settings_for
from lio_jax.run.track import track
from lio_jax.settings.settings import Settings
from tests.run.inertial_drive import RATE, START, InertialReplay, drive, imu, scans
from tests.run.small_drive import without_points

LATE_NS = 5_000_000
"""A scan arrives this long after its end."""
END = 15


def arrivals(recorded, samples, at):
    """Return scans and samples by the time of their arrival."""
    messages = [(at(scan), 0, scan) for scan in recorded]
    for row in zip(samples.stamp_ns.tolist(), samples.gyro, samples.accel, strict=True):
        messages.append((row[0], 1, row))
    return [message for *_, message in sorted(messages, key=lambda one: one[:2])]


def pushed(odometry, messages):
    results = []
    for message in messages:
        if isinstance(message, tuple):
            results += odometry.push_imu(*message)
        else:
            results += odometry.push_scan(message)
    return results


def after_its_end(scan):
    return scan.end_ns + LATE_NS


def at_its_start(scan):
    return scan.stamp_ns


@pytest.fixture(scope="module")
def read():
    """Settings that a run takes from the recording, and its results."""
    settings, _ = settings_for(InertialReplay(scans(end=END)[:1], None), Settings())
    feed, _ = imu_feed(InertialReplay(scans(end=END), imu()), settings)
    return settings, list(track(settings, scans(end=END), feed))


def new():
    return PushedOdometry(Settings(), drive().info.T_imu_lidar)


@pytest.mark.parametrize("at", [after_its_end, at_its_start])
def test_results_are_those_of_a_recording_to_the_bit(at, read):
    settings, expected = read
    odometry = new()
    results = pushed(odometry, arrivals(scans(end=END), imu(), at)) + odometry.finish()
    assert odometry.settings.values == settings.values
    assert odometry.settings.config == settings.config
    assert [one.stamp_ns for one in results] == [scan.end_ns for scan in scans(end=END)]
    for one, other in zip(results, expected, strict=True):
        assert one.T_world_imu.tobytes() == other.T_world_imu.tobytes()
        assert (one.failure, one.has_imu) == (other.failure, other.has_imu)


def test_a_scan_waits_for_its_samples_and_the_first_one_for_the_second():
    odometry, done, arrived = new(), [], 0
    for message in arrivals(scans(end=START + 5), imu(), after_its_end):
        done += pushed(odometry, [message])
        arrived += not isinstance(message, tuple)
        assert len(done) in ((0,) if arrived < 2 else (arrived - 1, arrived))
    assert len(done) == arrived == 5


def test_without_samples_a_scan_does_not_wait_for_ever():
    odometry = new()
    results = pushed(odometry, scans(end=END))
    assert 0 < len(results) < len(scans(end=END))
    assert len(results + odometry.finish()) == len(scans(end=END))


def test_damaged_samples_are_dropped(read):
    odometry, results = new(), []
    for message in arrivals(scans(end=END), imu(), after_its_end):
        if isinstance(message, tuple):
            stamp_ns, gyro, accel = message
            results += odometry.push_imu(stamp_ns - 1_000_000, gyro * np.nan, accel)
            results += odometry.push_imu(stamp_ns, gyro, accel)
            results += odometry.push_imu(stamp_ns, gyro + 1, accel)
        else:
            results += odometry.push_scan(message)
    expected = [one.T_world_imu.tobytes() for one in read[1]]
    assert [one.T_world_imu.tobytes() for one in results] == expected


def test_empty_first_scans_leave_the_settings_open():
    recorded = [without_points(one) if number < 2 else one for number, one in enumerate(scans(end=END))]
    odometry = new()
    results = pushed(odometry, arrivals(recorded, imu(), after_its_end)) + odometry.finish()
    assert [bool(one.failure) for one in results] == [True, True] + [False] * (len(recorded) - 2)


def test_nothing_pushed_gives_nothing():
    assert PushedOdometry(Settings()).finish() == []


def test_after_a_rehearsal_nothing_is_compiled():
    forget_programs()
    rehearse(Settings(), scans(end=END)[0], imu_rate=RATE)
    step = CompiledStep(Settings())
    pushed(new(), arrivals(scans(end=END), imu(), after_its_end))
    assert step.compile_s == 0.0
