"""Fixes with real odometry: the fixes that pass the gates, the alignment, and the graph's result."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.data.detect import open_sequence
from lio_jax.data.gps_checks import cleaned
from lio_jax.loops.gps import Fix, GpsGate, Refusal, alignment
from lio_jax.pose_graph.graph import ODOMETRY, POSITION, PoseGraph, poses_from, translations
from lio_jax.pose_graph.pose_graph import solve
from lio_jax.pose_graph.robust import Robust
from lio_jax.settings.settings import Settings
from tests.shared_data import SHARED_DATA, needs_shared

LEVER = np.array([-0.3, 0.4, 1.2])
YAW, SHIFT = 2.1, np.array([300.0, -150.0, 12.0])
UP = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Rotation from KITTI's camera axes to forward, left, up."""


def kitti_poses(name):
    rows = np.loadtxt(SHARED_DATA / "kiss_icp_kitti_00" / name).reshape(-1, 3, 4)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows
    return UP @ T @ np.linalg.inv(UP)


def antennas(T):
    return T[:, :3, :3] @ LEVER + T[:, :3, 3]


def fixes_of(truth, rng, sigma=1.0, multipath=1.0):
    """Return fixes at 10 Hz: white noise, and an error of half a minute that no covariance states."""
    position = Rotation.from_euler("z", YAW).apply(antennas(truth)) + SHIFT
    slow = np.zeros_like(position)
    kept = np.exp(-0.1 / 30)
    for k in range(1, len(slow)):
        slow[k] = kept * slow[k - 1] + np.sqrt(1 - kept**2) * multipath * rng.normal(size=3)
    return position + slow + sigma * rng.normal(size=position.shape)


@pytest.fixture(scope="module")
def town():
    """Return truth, a real odometry, the fixes that were used, and at which keyframes.

    KISS-ICP's on KITTI 00 (3.7 km), with an outage of a kilometre and a stretch of fixes 100 m off.
    """
    truth, odometry = kitti_poses("00_gt_kitti.txt"), kitti_poses("00_poses_kitti.txt")
    rng = np.random.default_rng(0)
    stamps = np.arange(len(truth)) * 100_000_000
    position = fixes_of(truth, rng)
    position[1200:1240] += [60.0, -80.0, 0.0]
    there = np.r_[0:2000, 3200 : len(truth)]
    covariance = np.tile(np.eye(3), (len(truth), 1, 1))
    values = Settings().values["gps"] | {"lever_arm": LEVER.tolist()}
    gate = GpsGate(stamps[there] + 20_000_000, position[there], covariance[there], values)
    frames = np.arange(0, len(truth), 2)
    found = [gate.used_fix(int(stamps[k]), odometry[k], odometry[k]) for k in frames]
    used = [number for number, each in enumerate(found) if isinstance(each, Fix)]
    return truth[frames], odometry[frames], [found[number] for number in used], np.array(used), gate


@needs_shared
def test_gates_leave_a_fix_every_few_metres_and_none_of_the_wrong_ones(town):
    truth, _, fixes, used, gate = town
    right = Rotation.from_euler("z", YAW).apply(antennas(truth[used])) + SHIFT
    errors = np.linalg.norm(np.array([fix.position for fix in fixes]) - right, axis=1)
    assert errors.max() < 8.0
    assert len(used) > 300
    assert gate.refusals[Refusal.JUMP] < 40
    assert gate.refusals[Refusal.TIME] > 500


@needs_shared
def test_the_heading_is_found_on_the_first_stretch(town):
    _, odometry, fixes, used, _ = town
    p = antennas(odometry[used])
    f, C, _ = (np.array(each) for each in zip(*fixes, strict=True))
    found = next(each for k in range(len(used)) if (each := alignment(p[:k], f[:k], C[:k], 0.1)) is not None)
    assert len(found.inlier) < 60
    yaw = np.arctan2(found.T_enu_odom[1, 0], found.T_enu_odom[0, 0])
    assert abs(yaw - YAW) < 0.2
    all_of_it = alignment(p, f, C, 0.1)
    assert abs(np.arctan2(all_of_it.T_enu_odom[1, 0], all_of_it.T_enu_odom[0, 0]) - YAW) < 0.02


def ate(positions, truth):
    """Return the rms distance after the best rigid alignment."""
    a, b = positions - positions.mean(0), truth - truth.mean(0)
    turn, _ = Rotation.align_vectors(b, a)
    return np.sqrt(np.mean(np.sum((turn.apply(a) - b) ** 2, axis=1)))


@needs_shared
def test_the_graph_takes_the_drift_out(town):
    truth, odometry, fixes, used, _ = town
    f, C, _ = (np.array(each) for each in zip(*fixes, strict=True))
    found = alignment(antennas(odometry[used]), f, C, 0.1)
    T_enu = found.T_enu_odom @ odometry
    count = len(odometry)
    T_i_j = np.linalg.inv(T_enu[:-1]) @ T_enu[1:]
    sigmas = np.array([2e-4] * 3 + [5e-3] * 3)
    information = np.zeros((count - 1 + len(used), 6, 6))
    information[: count - 1] = np.diag(sigmas**-2)
    information[count - 1 :, 3:, 3:] = np.linalg.inv(C)
    at = np.tile(np.eye(4), (len(used), 1, 1))
    at[:, :3, 3] = f
    lever = np.zeros((len(information), 3))
    lever[count - 1 :] = LEVER
    measured = np.concatenate([T_i_j, at])
    graph = PoseGraph(
        poses_from(T_enu[:, :3, :3], T_enu[:, :3, 3]),
        jnp.asarray(np.r_[np.arange(count - 1), used]),
        jnp.asarray(np.r_[np.arange(1, count), used]),
        poses_from(measured[:, :3, :3], measured[:, :3, 3]),
        jnp.asarray(information),
        jnp.asarray(np.r_[np.full(count - 1, ODOMETRY), np.full(len(used), POSITION)]),
        jnp.asarray(np.zeros(count, bool)),
        jnp.asarray(lever),
    )
    solution = solve(graph, "poses", Robust())
    assert solution.status == "converged"
    before, after = (ate(p, truth[:, :3, 3]) for p in (odometry[:, :3, 3], translations(solution.poses)))
    right = Rotation.from_euler("z", YAW).apply(antennas(truth[used])) + SHIFT
    assert before > 3.0
    assert after < before / 2
    assert after < np.sqrt(np.mean(np.sum((f - right) ** 2, axis=1)))


@needs_shared
def test_a_real_receiver_agrees_with_its_own_truth():
    """KITTI's INS: in the frame of its truth the fixes have no other heading."""
    sequence = open_sequence(SHARED_DATA / "kitti_raw" / "2011_09_26" / "2011_09_26_drive_0005_sync")
    gps, said = cleaned(sequence.gps(), "OXTS")
    assert said == ()
    truth = sequence.truth()
    gate = GpsGate(gps.stamp_ns, gps.position, gps.covariance, Settings().values["gps"])
    found = [gate.used_fix(int(stamp), T, T) for stamp, T in zip(truth.stamp_ns, truth.poses, strict=True)]
    used = [number for number, each in enumerate(found) if isinstance(each, Fix)]
    assert len(used) > 5
    f, C, _ = (np.array(each) for each in zip(*(found[number] for number in used), strict=True))
    aligned = alignment(truth.poses[used, :3, 3], f, C, 0.1)
    np.testing.assert_allclose(aligned.T_enu_odom, np.eye(4), atol=0.02)
