"""Poses at the inertial sensor's rate, against a known motion, and their reset at each correction."""

import dataclasses

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.core.types import NavState
from lio_jax.imu.imu_odometry import imu_rate_trajectory, poses_at_samples
from tests.imu.motion import ideal_imu, nav_at, quick_jit

BEGIN_NS = 1_700_000_000_123_456_789
OFFSET_NS = 3_000_000
SCANS = np.array([0, 100_000_000, 200_000_000, 300_000_000])
"""Scan ends after BEGIN_NS, where the motion's clock stands at zero."""
SAMPLES = np.arange(-2, 66) * 5_000_000 + 700_000


@pytest.fixture(scope="module")
def recording() -> dict:
    batch = ideal_imu(SAMPLES * 1e-9, size=len(SAMPLES))
    return {
        "stamps_ns": BEGIN_NS + SCANS,
        "states": [nav_at(t * 1e-9, OFFSET_NS * 1e-9) for t in SCANS],
        "imu_stamps_ns": BEGIN_NS + SAMPLES + OFFSET_NS,
        "gyro": np.asarray(batch.gyro),
        "accel": np.asarray(batch.accel),
    }


def shifted(nav: NavState, by: np.ndarray) -> NavState:
    pose = jaxlie.SE3.from_rotation_and_translation(
        nav.T_world_imu.rotation(), nav.T_world_imu.translation() + by
    )
    return dataclasses.replace(nav, T_world_imu=pose)


def true_poses(since_ns: np.ndarray) -> np.ndarray:
    return np.stack([np.asarray(nav_at(t * 1e-9).T_world_imu.as_matrix()) for t in since_ns])


def test_every_sample_between_first_and_last_state_has_its_pose_once(recording: dict) -> None:
    stamps, poses = imu_rate_trajectory(**recording)
    first, last = np.searchsorted(SAMPLES, [SCANS[0], SCANS[-1]], side="right")
    inside = SAMPLES[first:last]
    np.testing.assert_array_equal(stamps, BEGIN_NS + inside)
    matrices = np.asarray(jaxlie.SE3(jnp.asarray(poses)).as_matrix())
    np.testing.assert_allclose(matrices, true_poses(inside), atol=2e-4)


def test_a_sample_at_a_scans_end_is_not_doubled(recording: dict) -> None:
    moved = {**recording, "imu_stamps_ns": recording["imu_stamps_ns"] - 700_000}
    stamps, _ = imu_rate_trajectory(**moved)
    assert np.all(np.diff(stamps) == 5_000_000)
    assert len(stamps) == 60
    assert stamps[-1] == BEGIN_NS + SCANS[-1]


def test_a_correction_acts_from_its_scan_on(recording: dict) -> None:
    jump = np.array([0.0, 0.5, 0.0])
    states = [*recording["states"]]
    states[1] = shifted(states[1], jump)
    plain, corrected = (
        imu_rate_trajectory(**{**recording, "states": s}) for s in (recording["states"], states)
    )
    change = corrected[1][:, 4:] - plain[1][:, 4:]
    since = plain[0] - BEGIN_NS
    second = (since > SCANS[1]) & (since <= SCANS[2])
    np.testing.assert_allclose(change[second], np.broadcast_to(jump, (second.sum(), 3)), atol=1e-12)
    np.testing.assert_array_equal(change[~second], 0)


def test_without_samples_in_between_there_are_no_poses(recording: dict) -> None:
    far = {**recording, "imu_stamps_ns": recording["imu_stamps_ns"] + 10_000_000_000}
    stamps, poses = imu_rate_trajectory(**far)
    assert stamps.shape == (0,)
    assert poses.shape == (0, 7)


def test_one_state_gives_an_empty_trajectory(recording: dict) -> None:
    one = {**recording, "stamps_ns": recording["stamps_ns"][:1], "states": recording["states"][:1]}
    assert imu_rate_trajectory(**one)[1].shape == (0, 7)


def test_states_without_stamps_are_refused(recording: dict) -> None:
    with pytest.raises(LioJaxError, match="3 stamps were given for 4 states"):
        imu_rate_trajectory(**{**recording, "stamps_ns": recording["stamps_ns"][:3]})


def test_times_that_run_backwards_are_refused(recording: dict) -> None:
    backwards = recording["imu_stamps_ns"][::-1].copy()
    with pytest.raises(LioJaxError, match="inertial samples do not ascend"):
        imu_rate_trajectory(**{**recording, "imu_stamps_ns": backwards})


def test_rows_outside_the_span_and_padding_are_marked_and_finite() -> None:
    batch = ideal_imu(0.01 * np.arange(-1, 12), size=32)
    poses, inside = quick_jit(poses_at_samples)(nav_at(0.0), batch, jnp.asarray(0.0), jnp.asarray(0.05))
    np.testing.assert_array_equal(np.flatnonzero(inside), np.arange(2, 7))
    assert bool(jnp.all(jnp.isfinite(poses.wxyz_xyz)))
