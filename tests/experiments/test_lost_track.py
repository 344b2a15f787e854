"""Loss of track is distinguished from drift."""

import numpy as np
import pytest

from lio_jax.data.trajectory import Trajectory
from tests.experiments import bench_path  # noqa: F401

from scoring import lost_after  # isort: skip

STEP_NS = 100_000_000


def drive(speed: np.ndarray, start_ns: int = 0) -> Trajectory:
    """Return poses 0.1 s apart along x at the given speeds, m/s."""
    poses = np.tile(np.eye(4), (len(speed), 1, 1))
    poses[:, 0, 3] = np.cumsum(speed) * 0.1
    return Trajectory(start_ns + STEP_NS * np.arange(len(speed)), poses)


TRUTH = drive(np.full(100, 5.0))


def test_the_truth_itself_is_not_lost():
    assert lost_after(TRUTH, TRUTH) is None


def test_where_the_world_is_does_not_matter():
    moved = TRUTH.poses.copy()
    moved[:, :3, 3] += [100.0, -50.0, 3.0]
    assert lost_after(Trajectory(TRUTH.stamp_ns, moved), TRUTH) is None


def test_slow_drift_is_not_a_loss():
    assert lost_after(drive(np.full(100, 5.4)), TRUTH) is None


def test_standing_still_while_the_vehicle_drives_on_is_a_loss_from_then_on():
    speed = np.where(np.arange(100) < 60, 5.0, 0.0)
    # 0.5 m are missing after the pose at 6.0 s, more than that one scan later
    assert lost_after(drive(speed), TRUTH) == pytest.approx(6.1)


def test_a_sudden_turn_is_a_loss():
    turned = TRUTH.poses.copy()
    angle = np.deg2rad(11.0)
    turned[70:, :2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    assert lost_after(Trajectory(TRUTH.stamp_ns, turned), TRUTH) == pytest.approx(7.0)


def test_scans_without_a_pose_are_bridged():
    keep = np.ones(100, bool)
    keep[30:38] = False
    assert lost_after(Trajectory(TRUTH.stamp_ns[keep], TRUTH.poses[keep]), TRUTH) is None
