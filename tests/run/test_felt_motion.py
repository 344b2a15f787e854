"""The estimated motion is compared with the felt one: a lift is noticed, a drive is not."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.run.felt_motion import FeltMotionCheck

GRAVITY = np.array([0.0, 0.0, -9.80665])
BIAS = np.array([0.02, -0.01, 0.03])
GYRO_BIAS = np.array([0.001, 0.002, -0.003])
RATE = 200.0


def drive(time):
    """Return position, attitude and specific force of a body that turns, speeds up and heaves."""
    angle = 0.3 * np.sin(time) + 0.4 * time
    rotation = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0])
    place = np.column_stack([np.sin(0.7 * time), 0.5 * time**2, 0.1 * np.cos(2 * time)])
    pushed = np.column_stack([-0.49 * np.sin(0.7 * time), np.ones(len(time)), -0.4 * np.cos(2 * time)])
    return place, rotation, rotation.inv().apply(pushed - GRAVITY)


def compared(seconds=6.0, estimated=None, spoilt=None, rate=RATE):
    """Return the comparison after each scan of 0.1 s.

    Args:
        seconds: length of the drive.
        estimated: function of the true positions and times that returns the estimated ones.
        spoilt: function that changes the specific forces (m, 3) at times (m,).
        rate: samples per second.
    """
    time = np.arange(-1.0, seconds + 0.5, 1 / rate)
    force = drive(time)[2]
    gyro = np.outer(0.3 * np.cos(time) + 0.4, [0.0, 0.0, 1.0]) + GYRO_BIAS
    force = force + BIAS if spoilt is None else spoilt(force + BIAS, time)
    nav = SimpleNamespace(accel_bias=BIAS, gyro_bias=GYRO_BIAS, gravity=GRAVITY, time_offset=0.0)
    scan = SimpleNamespace(duration=0.1, interval=0.1)
    check, found = FeltMotionCheck(), []
    for number in range(int(seconds * 10)):
        end = 0.1 * (number + 1)
        near = np.abs(time - (end - 0.05)) < 0.1
        imu = SimpleNamespace(
            time=time[near] - (end - 0.1), gyro=gyro[near], accel=force[near], mask=np.ones(near.sum(), bool)
        )
        place, attitude, _ = drive(np.array([end]))
        pose = np.eye(4)
        pose[:3, :3] = attitude.as_matrix()[0]
        pose[:3, 3] = place[0] if estimated is None else estimated(place[0], end)
        found.append(check(round(end * 1e9), scan, imu, nav, pose, breaks=False))
    return found


def errors(found):
    return np.array([one.error for one in found if one is not None])


def test_a_right_estimate_moves_as_the_samples_feel():
    found = errors(compared())
    assert len(found) >= 60 - 21
    # linear interpolation between samples and turns about one axis
    assert np.abs(found).max() < 2e-3


def test_a_motion_that_the_scans_do_not_show_is_measured():
    # the samples feel 1 m/s^2 upwards from 3 s on, and the estimate does not rise
    found = errors(compared(spoilt=lambda force, time: force + np.outer(time > 3.0, [0.0, 0.0, 1.0])))
    # with both spans after 3 s, the second one should lead by a T^2
    assert found[-1] == pytest.approx([0.0, 0.0, -1.0], abs=0.02)
    assert np.abs(found[:9]).max() < 2e-3


def test_a_motion_that_only_the_scans_show_is_measured():
    found = errors(compared(estimated=lambda place, end: place + 0.25 * end**2 * np.eye(3)[0]))
    assert found[-1] == pytest.approx([0.5, 0.0, 0.0], abs=0.02)


@pytest.mark.parametrize(
    "spoilt",
    [
        {"rate": 20.0},
        {"spoilt": lambda force, time: force + np.outer(np.abs(time % 1.0) < 0.02, [0, 0, 60.0])},
    ],
    ids=["slow samples", "a shock each second"],
)
def test_what_happens_between_the_samples_is_not_judged(spoilt):
    assert not len(errors(compared(**spoilt)))
