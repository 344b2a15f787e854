"""The back end on a circle driven twice: what loops and fixes, true or false, make of a drifting odometry."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.loops.back_end import BackEnd, Edge, corrected_poses, levelled_onto, solved
from lio_jax.loops.gps import GpsGate
from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.proposals import Proposal
from lio_jax.loops.verification import Verdict
from lio_jax.pose_graph.graph import LOOP, ODOMETRY
from lio_jax.settings.settings import Settings
from tests.loops.drives import LEVER, SHIFT, SPEED, YAW, poses_at, to_enu

LAP, COUNT = 126, 252
SECONDS = np.arange(COUNT) / SPEED
TRUTH = poses_at(SECONDS)
STAMPS = np.round(SECONDS * 1e9).astype(np.int64)
SIGMAS = np.array([1e-3] * 3 + [1e-2] * 3)


def odometry(drift=1.0) -> np.ndarray:
    """Return the drive with a scale that is 1 % off and a heading that turns away."""
    steps = np.linalg.inv(TRUTH[:-1]) @ TRUTH[1:]
    wrong = np.eye(4)
    wrong[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 2e-4 * drift]).as_matrix()
    poses = [TRUTH[0]]
    for step in steps:
        step = step.copy()
        step[:3, 3] *= 1 + 0.01 * drift
        poses.append(poses[-1] @ step @ wrong)
    return np.array(poses)


def keyframes(poses: np.ndarray) -> list[Keyframe]:
    none = np.zeros((0, 3), np.float32)
    rows = enumerate(zip(STAMPS, poses, strict=True))
    return [Keyframe(k, int(stamp), pose, none, np.diag(SIGMAS**2)) for k, (stamp, pose) in rows]


def loop(source: int, target: int, T_target_source: np.ndarray) -> Verdict:
    proposal = Proposal(source, target, "radius", T_target_source, 1.0, 0.1, 1.0)
    information = np.diag(np.array([0.01] * 3 + [0.05] * 3) ** -2)
    return Verdict(proposal, True, "", T_target_source, information)


@dataclass
class Found:
    """Replace a loop closer by one that returns given loops."""

    at: dict[int, Verdict]
    closed: list[Verdict] = field(default_factory=list)

    def take(self, frames, poses):
        assert len(frames) == len(poses)
        entering = [self.at[len(frames) - 1]] if len(frames) - 1 in self.at else []
        self.closed += entering
        return entering

    def outcomes(self):
        return self.closed


def true_loops(every: int = 15) -> dict[int, Verdict]:
    return {
        source: loop(source, source - LAP, np.linalg.inv(TRUTH[source - LAP]) @ TRUTH[source])
        for source in range(LAP, COUNT, every)
    }


def run(closer=None, gate=None, poses=None, lever=(0.0, 0.0, 0.0)):
    settings = Settings()
    settings.values["gps"]["lever_arm"] = list(lever)
    back_end = BackEnd(settings, closer, gate)
    for keyframe in keyframes(odometry() if poses is None else poses):
        back_end.add(keyframe)
    back_end.settle()
    return back_end.correction()


def off(poses: np.ndarray) -> float:
    """Return the root mean square distance from the truth, m."""
    return float(np.sqrt(np.mean(np.sum((poses[:, :3, 3] - TRUTH[:, :3, 3]) ** 2, axis=1))))


def between_laps(poses: np.ndarray) -> float:
    """Return the root mean square error of one lap's places as seen from the other's, m."""
    apart, true = (np.linalg.inv(T[:LAP]) @ T[LAP:] for T in (poses, TRUTH))
    return float(np.sqrt(np.mean(np.sum((apart[:, :3, 3] - true[:, :3, 3]) ** 2, axis=1))))


def test_without_loops_and_fixes_the_odometry_stays_to_the_last_bit():
    found = run()
    np.testing.assert_array_equal(found.T_odom_imu, odometry())
    np.testing.assert_allclose(found.T_world_imu, odometry(), atol=1e-12)
    assert found.T_enu_world is None


def test_loops_take_the_drift_away():
    found = run(Found(true_loops()))
    assert off(found.T_world_imu) < off(odometry()) / 2
    np.testing.assert_allclose(found.T_world_imu[0], TRUTH[0], atol=1e-12)
    assert between_laps(found.T_world_imu) < 0.2
    assert between_laps(odometry()) > 1.5
    assert [weight for _, weight in found.loops] == [1.0] * len(true_loops())


def test_a_false_loop_bends_nothing_and_shows_its_weight():
    wrong = loop(200, 10, np.eye(4))
    loops = true_loops()
    right = run(Found(dict(loops)))
    found = run(Found(loops | {200: wrong}))
    assert off(found.T_world_imu) < 2 * off(right.T_world_imu)
    weights = {verdict.proposal.source: weight for verdict, weight in found.loops}
    assert weights.pop(200) < 1e-3
    assert set(weights.values()) == {1.0}


def test_fixes_give_place_and_heading_though_neither_is_known():
    rng = np.random.default_rng(0)
    fix_ns = STAMPS[::2] + 10_000_000
    antennas = poses_at(fix_ns * 1e-9)
    positions = to_enu(antennas[:, :3, :3] @ LEVER + antennas[:, :3, 3])
    outage = (fix_ns > 8e9) & (fix_ns < 12e9)
    kept = ~outage
    covariance = np.tile(0.3**2 * np.eye(3), (int(kept.sum()), 1, 1))
    noisy = (positions + rng.normal(0, 0.3, positions.shape))[kept]
    values = Settings().values["gps"] | {"lever_arm": LEVER.tolist()}
    gate = GpsGate(fix_ns[kept], noisy, covariance, values)
    found = run(gate=gate, poses=odometry(0.5), lever=LEVER)
    assert found.fixes["used"] > 20
    T_enu_world = np.eye(4)
    T_enu_world[:3, :3] = Rotation.from_euler("z", YAW).as_matrix()
    T_enu_world[:3, 3] = SHIFT
    # the world's heading and place are the first keyframe's: it is the trajectory on the earth that is known
    on_earth, truth = found.T_enu_world @ found.T_world_imu, T_enu_world @ TRUTH
    errors = np.linalg.norm(on_earth[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert np.sqrt(np.mean(errors**2)) < 0.4
    assert off(odometry(0.5)) > 1.0
    np.testing.assert_allclose(found.T_world_imu[0, :3, 3], TRUTH[0, :3, 3], atol=1e-9)


def test_the_result_is_the_same_whenever_it_is_asked_for():
    loops = true_loops()
    back_end = BackEnd(Settings(), Found(dict(loops)), None)
    for keyframe in keyframes(odometry()):
        back_end.add(keyframe)
        back_end.correction()
    back_end.settle()
    np.testing.assert_array_equal(back_end.correction().T_world_imu, run(Found(dict(loops))).T_world_imu)


def test_poses_between_keyframes_move_with_both():
    every = np.arange(0, COUNT, 10)
    corrected = TRUTH[every]
    poses = corrected_poses(STAMPS, odometry(), STAMPS[every], odometry()[every], corrected)
    np.testing.assert_allclose(poses[every], corrected, atol=1e-12)
    steps = np.linalg.norm((np.linalg.inv(poses[:-1]) @ poses[1:])[:, :3, 3], axis=1)
    true_steps = np.linalg.norm((np.linalg.inv(TRUTH[:-1]) @ TRUTH[1:])[:, :3, 3], axis=1)
    np.testing.assert_allclose(steps, true_steps, rtol=0.03)
    since_last = np.linalg.inv(odometry()[every[-1]]) @ odometry()[-1]
    np.testing.assert_allclose(poses[-1], corrected[-1] @ since_last, atol=1e-12)


@pytest.mark.parametrize("yaw", [0.3, -3.0])
def test_a_level_frame_is_laid_onto_another(yaw):
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_euler("z", yaw).as_matrix(), [1.0, -2.0, 3.0]
    pose = TRUTH[7]
    np.testing.assert_allclose(levelled_onto(pose, turn @ pose), turn, atol=1e-12)
    tilted = pose.copy()
    tilted[:3, :3] = Rotation.from_euler("x", 0.05).as_matrix() @ pose[:3, :3]
    found = levelled_onto(tilted, turn @ pose)
    np.testing.assert_allclose(found[2, :3], [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(("wrong_by", "weight"), [(0.0, 1.0), (45.0, 0.0)])
def test_a_loop_that_only_bends_the_odometry_is_rejected(wrong_by, weight):
    """The odometry states so little that it can follow the loop; no edge is improbable by itself."""
    poses = np.tile(np.eye(4), (21, 1, 1))
    poses[:, 0, 3] = np.arange(21.0)
    step, whole = poses[1], poses[20].copy()
    whole[1, 3] += wrong_by
    loose, tight = (np.diag(np.repeat([rad, m], 3) ** -2.0) for rad, m in ((0.02, 0.2), (0.002, 0.05)))
    edges = [Edge(ODOMETRY, k, k + 1, step, loose) for k in range(20)]
    edges.append(Edge(LOOP, 0, 20, whole, tight))
    found = solved(poses, edges)
    assert found.weights[-1] == weight
    np.testing.assert_allclose(found.poses, poses, atol=1e-6)
