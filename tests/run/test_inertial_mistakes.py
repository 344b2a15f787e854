"""Faulty inertial samples: one clear sentence each, and an estimate that stays finite."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import jax
import numpy as np
import pytest

from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.run import imu_feed
from lio_jax.run.track import ScanResult, track
from lio_jax.settings.settings import Settings
from tests.run.inertial_drive import (
    END,
    RATE,
    START,
    InertialReplay,
    changed,
    errors,
    imu,
    only,
    scans,
    seconds,
)
from tests.run.small_drive import without_points


@dataclass
class Replayed:
    """A run's results and its messages."""

    tracked: list[ScanResult]
    warnings: list[str]

    @property
    def failures(self) -> dict[int, str]:
        return {item.index: item.failure for item in self.tracked if item.failure}

    @property
    def errors(self) -> np.ndarray:
        return errors(
            Trajectory(
                np.array([item.stamp_ns for item in self.tracked]),
                np.stack([item.T_world_imu for item in self.tracked]),
            )
        )

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of each position, m."""
        covariances = np.stack([np.asarray(item.output.covariance) for item in self.tracked])
        return np.sqrt(np.trace(covariances[:, 3:6, 3:6], axis1=1, axis2=2))


Replayer = Callable[[Iterable[LidarScan], ImuData], Replayed]


@pytest.fixture(scope="module")
def replayed(inertial_settings: Settings) -> Replayer:
    """Return a function that runs scans and samples through one compiled step."""
    step = CompiledStep(inertial_settings)

    def run(scans: Iterable[LidarScan], imu: ImuData) -> Replayed:
        replay = InertialReplay(scans, imu)
        feed, found = imu_feed(replay, inertial_settings)
        assert feed is not None
        tracked = list(track(inertial_settings, replay.scans(), feed, step))
        for item in tracked:
            state = (item.nav, item.T_world_imu, item.output.covariance, item.output.nis)
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state)), item.index
        return Replayed(tracked, [*found, *feed.warnings()])

    return run


@pytest.fixture(scope="module")
def plain(replayed: Replayer) -> Replayed:
    return replayed(scans(), imu())


def test_good_samples_are_not_mentioned(plain: Replayed) -> None:
    assert plain.warnings == []
    assert plain.failures == {}
    # measured: 0.009 m
    assert plain.errors.max() < 0.02


def test_a_gap_is_named_and_bridged(replayed: Replayer) -> None:
    """While the vehicle pulls away at 2 m/s^2."""
    t = seconds()
    seen = replayed(scans(), only((t < 1.503) | (t > 2.003)))
    [warning] = seen.warnings
    assert re.match(r"IMU: 1 gap\(s\) without IMU samples .*: 0\.51\d s at", warning)
    assert seen.failures == {}
    assert seen.errors.max() < 0.03
    # scan 17 lies in the gap
    assert seen.sigma[17] > 1.2 * replayed(scans(), imu()).sigma[17]


def test_a_gap_of_two_seconds_in_a_bend_is_bridged(replayed: Replayer) -> None:
    t = seconds()
    seen = replayed(scans(30, 75), only((t < 4.0) | (t > 6.0)))
    assert seen.failures == {}
    # where nothing bridges the gap it is 1.9 times as large
    assert seen.errors.max() < 1.5 * replayed(scans(30, 75), imu()).errors.max()


def test_samples_that_start_late_are_named(replayed: Replayer) -> None:
    """The vehicle moves when the first sample arrives."""
    seen = replayed(scans(), only(seconds() > 1.5))
    assert any(re.match(r"the IMU starts 1\.5\d\d s after the first scan", said) for said in seen.warnings)
    assert seen.failures == {}
    assert seen.errors.max() < 0.03


def test_samples_that_end_early_are_named(replayed: Replayer) -> None:
    seen = replayed(scans(), only(seconds() < 2.0))
    assert any(re.match(r"the IMU ends \d\.\d\d\d s before the last scan", said) for said in seen.warnings)
    assert seen.failures == {}
    # constant velocity lags behind the acceleration
    assert seen.errors.max() < 0.08


def test_an_accelerometer_in_g_is_converted(replayed: Replayer, plain: Replayed) -> None:
    seen = replayed(scans(), changed(accel=imu().accel / 9.80665))
    [warning] = seen.warnings
    assert re.fullmatch(r"IMU: accelerometer in g \(median 1\.00\d\): converted to m/s\^2\.", warning)
    for one, other in zip(seen.tracked, plain.tracked, strict=True):
        np.testing.assert_allclose(one.T_world_imu, other.T_world_imu, atol=1e-6)


def test_a_gyroscope_in_degrees_is_suspected(replayed: Replayer) -> None:
    seen = replayed(scans(), changed(gyro=np.degrees(imu().gyro)))
    [warning] = seen.warnings
    assert "it is suspected that the gyroscope is in deg/s" in warning


def test_a_force_that_points_down_is_said(replayed: Replayer) -> None:
    seen = replayed(scans(), changed(accel=-imu().accel))
    [warning] = seen.warnings
    assert warning.startswith("IMU: the specific force points down at rest")
    assert "negated" in warning


def test_a_repeated_stamp_is_left_out(replayed: Replayer, plain: Replayed) -> None:
    stamps = imu().stamp_ns.copy()
    at = int(np.searchsorted(seconds(), 2.0))
    stamps[at] = stamps[at - 1]
    seen = replayed(scans(), replace(imu(), stamp_ns=stamps))
    assert len(seen.warnings) == 1
    assert "1 IMU sample(s) repeat a stamp" in seen.warnings[0]
    assert abs(seen.errors - plain.errors).max() < 0.003


def test_time_that_runs_backwards_drops_what_is_out_of_order(replayed: Replayer) -> None:
    stamps = imu().stamp_ns.copy()
    at = int(np.searchsorted(seconds(), 2.0))
    stamps[at : at + 10] -= 703_000_000
    seen = replayed(scans(), replace(imu(), stamp_ns=stamps))
    assert "runs backwards 1 time(s)" in seen.warnings[0]
    assert "10 sample(s) out of order were dropped" in seen.warnings[0]
    assert seen.failures == {}
    assert seen.errors.max() < 0.03


def test_saturation_is_said(replayed: Replayer) -> None:
    """A shock of 40 m/s^2 at 15 Hz that a unit of 2 g cuts off."""
    t = seconds()
    shaken = imu().accel.copy()
    hit = (t > 1.5) & (t < 1.9)
    shaken[hit, 1] += 40 * np.sin(2 * np.pi * 15 * t[hit])
    seen = replayed(scans(), changed(accel=shaken.clip(-2 * 9.80665, 2 * 9.80665)))
    [warning] = seen.warnings
    assert "accelerometer's y axis stays at -19.61 and 19.61 m/s^2" in warning
    assert "saturated" in warning
    assert seen.errors.max() < 0.05


def test_a_gyroscope_of_too_small_a_range_is_survived(replayed: Replayer) -> None:
    """In a bend of 0.5 rad/s."""
    fastest = np.abs(imu().gyro[:, 2]).max()
    seen = replayed(scans(30, 75), changed(gyro=imu().gyro.clip(-0.6 * fastest, 0.6 * fastest)))
    assert any("saturated" in one for one in seen.warnings)
    assert seen.failures == {}
    assert seen.errors.max() < 2 * replayed(scans(30, 75), imu()).errors.max()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["gyro", "accel"])
def test_samples_that_are_not_finite_are_left_out(replayed: Replayer, name: str, value: float) -> None:
    at = int(np.searchsorted(seconds(), 2.0))
    seen = replayed(scans(), changed(slice(at, at + 3), **{name: value}))
    assert len(seen.warnings) == 1
    assert "3 IMU sample(s) held NaN or infinity" in seen.warnings[0]
    assert seen.failures == {}
    assert seen.errors.max() < 0.02


@pytest.mark.parametrize("name", ["gyro", "accel"])
def test_a_sample_beyond_any_sensor_is_left_out(replayed: Replayer, name: str) -> None:
    """Finite, but its square is not."""
    at = int(np.searchsorted(seconds(), 2.0))
    seen = replayed(scans(), changed(slice(at, at + 1), **{name: 1e200}))
    assert len(seen.warnings) == 1
    assert "1 IMU sample(s) held a value beyond any sensor's range" in seen.warnings[0]
    assert seen.failures == {}
    assert seen.errors.max() < 0.02


RETURN = END + 50


@pytest.mark.parametrize("empty", [False, True], ids=["no scans", "scans without points"])
def test_five_seconds_without_lidar_are_predicted_and_recovered_from(replayed: Replayer, empty: bool) -> None:
    """25 m at 5 m/s and through a curve on inertial samples alone."""
    between = [replace(without_points(scans()[-1]), stamp_ns=s) for s in _stamps(END, RETURN)]
    seen = replayed([*scans(), *(between if empty else []), *scans(RETURN, RETURN + 4)], imu())
    back = len(seen.tracked) - 4
    if empty:
        assert seen.sigma[back] < 0.1 * seen.sigma[back - 1]
        assert set(seen.failures) == set(range(END - START, back))
        assert set(seen.failures.values()) == {"it holds no points; the pose is the prediction."}
        outage = seen.sigma[END - START : back]
        assert np.all(np.diff(outage) > 0)
        assert outage[-1] > 10 * seen.sigma[END - START - 1]
        assert np.all(seen.errors[END - START : back] < 3 * outage + 0.02)
    else:
        assert seen.failures == {
            back: "no scan came for 5.10 s before it: inertial samples predicted the motion."
        }
    assert seen.errors[back:].max() < 0.05
    # the map holds little of what the vehicle sees now, so few planes correct the prediction; measured: 4.3
    assert seen.sigma[back:].max() < 5 * seen.sigma[END - START - 1]
    assert np.all(seen.errors[back:] < 3 * seen.sigma[back:])


def test_a_force_that_is_not_there_names_speed_and_cause(replayed: Replayer) -> None:
    """The scans end, the samples go on with a force that is not there."""
    pushed = imu().accel.copy()
    pushed[seconds() > 3.0] += [30.0, 0.0, 0.0]
    empty = [replace(without_points(scans()[-1]), stamp_ns=s) for s in _stamps(END, END + 30)]
    seen = replayed([*scans(), *empty], changed(accel=pushed))
    fast = [index for index, said in seen.failures.items() if "params.limits.speed" in said]
    speeds = [float(np.linalg.norm(item.nav.velocity)) for item in seen.tracked]
    assert len(fast) == 1
    assert speeds[fast[0] - 1] <= 60 < speeds[fast[0]]
    assert re.search(
        r"The speed reached 6\d\.\d m/s, above params\.limits\.speed=60: "
        r"likely because the scan was not matched\.",
        seen.failures[fast[0]],
    )


def _stamps(start: int, end: int) -> list[int]:
    first = scans()[0].stamp_ns
    return [first + (number - START) * 100_000_000 for number in range(start, end)]


def test_the_drive_is_sampled_as_the_tests_think() -> None:
    assert np.all(np.diff(imu().stamp_ns) == round(1e9 / RATE))


def test_samples_that_end_in_a_bend_do_not_end_the_estimate(replayed: Replayer) -> None:
    """For five seconds constant rate and velocity predict the motion."""
    seen = replayed(scans(30, 85), only(seconds() < 3.5))
    assert seen.failures == {}
    # with a rate of zero, or an error that is constant over each sweep, it is five times as large
    assert seen.errors.max() < 2 * replayed(scans(30, 85), imu()).errors.max()
