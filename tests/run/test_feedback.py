"""Corrections of the back end in the running odometry: when, in which frame, and what a run writes."""

import time
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation
from simulated_keyframes import driven, rounded

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import ImuData
from lio_jax.data.trajectory import Trajectory, read_tum
from lio_jax.evaluation.trajectory_error import align, position_errors
from lio_jax.loops.back_end import BackEnd
from lio_jax.run.feedback import DELAY, Feedback
from lio_jax.run.global_correction import BackEndThread
from lio_jax.run.run import run_sequence, settings_for
from lio_jax.settings.settings import Settings, recipe_settings, with_overrides
from lio_jax.sim.blocks import LANE, PITCH, lap
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import EPOCH_NS, SimulatedSequence, build
from tests.run import inertial_drive
from tests.run.inertial_drive import InertialReplay
from tests.run.small_drive import without_points
from tests.run.test_resume import contents, killed_at, resumable

COUNT = 12
LIFT = np.eye(4)
LIFT[:3, 3] = [0.1, 0.0, 0.2]


@dataclass(frozen=True)
class Echo:
    """A recipe whose state is the last correction."""

    def corrected(self, params: Any, state: Any, T_new_old: jaxlie.SE3, keyframes: jaxlie.SE3) -> Any:
        """Return the correction, and the state with it: all are arrays."""
        return T_new_old, keyframes


class Nav(eqx.Module):
    T_world_imu: jaxlie.SE3
    velocity: Float[Array, "3"]
    gravity: Float[Array, "3"]


class Seen(eqx.Module):
    """The parts of an output that feedback reads."""

    registration: Any
    keyframes: Any
    origin: Float[Array, "3"]
    points: Float[Array, "m 3"]


class Registered(eqx.Module):
    T_world_lidar: jaxlie.SE3


def se3(T):
    return jaxlie.SE3.from_matrix(jnp.asarray(T))


def odometry_poses():
    """Return (COUNT, 4, 4) level poses along a curve."""
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    yaw = 0.1 * np.arange(COUNT)
    T[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw, 0 * yaw, 0.05 + 0 * yaw], 1)).as_matrix()
    T[:, :2, 3] = np.stack([np.cumsum(np.cos(yaw)), np.cumsum(np.sin(yaw))], 1)
    return T


def bent(T, drift=0.02):
    """Return poses whose drift (m, rad) grows from pose to pose, tilt included."""
    grown = drift * np.arange(len(T))
    turn = Rotation.from_euler("ZYX", np.stack([grown, 0.1 * grown, -0.2 * grown], 1)).as_matrix()
    corrected = T.copy()
    corrected[:, :3, :3] = turn @ T[:, :3, :3]
    corrected[:, :3, 3] += np.stack([grown, -2 * grown, grown], 1)
    return corrected


def stamp(number):
    return 1_000_000_000 + 100_000_000 * number


def output_in_map(T_map_odom, T_odom_imu, number):
    """Return navigation state and output of a scan that is the recipe's next keyframe."""
    T = T_map_odom @ T_odom_imu
    table = SimpleNamespace(
        numbers=np.array([*range(number + 1), *[-1] * (COUNT - number)], np.int32), added=np.int32(number)
    )
    rows = np.arange(6.0).reshape(2, 3).astype(np.float32)
    origin = np.array([3.0, 1.0, 0.0])
    seen = Seen(
        Registered(se3(T @ LIFT)), table, T_map_odom[:3, :3] @ origin + T_map_odom[:3, 3],
        (rows @ T_map_odom[:3, :3].T).astype(np.float32),
    )  # fmt: skip
    turned = [T_map_odom[:3, :3] @ np.array(one) for one in ([1.0, 2.0, 0.5], [0.1, 0.2, -9.8])]
    return Nav(se3(T), *turned), seen


def fed_back(until):
    """Return feedback after scans of which each is a keyframe, the state, and when it was corrected."""
    poses = odometry_poses()

    def correction_after(index):
        known = slice(0, index + 1)
        stamps = np.array([stamp(number) for number in range(index + 1)])
        found = SimpleNamespace(stamp_ns=stamps, T_odom_imu=poses[known], T_world_imu=bent(poses)[known])
        return found if index == 3 else None

    feedback = Feedback(Echo(), None)
    feedback.follow(correction_after)
    T_map_odom, state, corrected_before = np.eye(4), (jnp.zeros(()),), []
    for number in range(until):
        if number >= 2:
            feedback.add_keyframe(number - 2)
        before, state = state, feedback.applied(state, number, None)
        if state is not before:
            corrected_before.append(number)
            T_map_odom = np.asarray(state[0].as_matrix())
        feedback.take(stamp(number), output_in_map(T_map_odom, poses[number], number)[1])
    return feedback, state, corrected_before, T_map_odom


def test_a_correction_is_applied_a_fixed_number_of_keyframes_later():
    # the sinks have scans up to the one before the last
    assert fed_back(COUNT)[2] == [3 + DELAY + 2]


def test_the_vehicle_moves_level_to_where_the_back_end_sees_it():
    _, _, _, T_map_odom = fed_back(COUNT)
    last, found = odometry_poses()[3], bent(odometry_poses())[3]
    np.testing.assert_allclose(T_map_odom[2], [0, 0, 1, found[2, 3] - last[2, 3]], atol=1e-12)
    np.testing.assert_allclose((T_map_odom @ last)[:3, 3], found[:3, 3], atol=1e-12)


def test_keyframes_lie_to_each_other_as_the_back_end_sees_them():
    _, (T_new_old, rows), _, _ = fed_back(3 + DELAY + 3)
    odometry, found = odometry_poses(), bent(odometry_poses())
    count = 3 + DELAY + 2
    T_map_lidar = np.asarray(rows.as_matrix())[:count]
    between = np.linalg.inv(T_map_lidar[3]) @ T_map_lidar
    expected = np.linalg.inv(LIFT) @ np.linalg.inv(found[3]) @ found @ LIFT
    np.testing.assert_allclose(between[:4], expected[:4], atol=1e-9)
    # those after the last one that the back end knows keep their place beside the vehicle
    moved = np.asarray(T_new_old.as_matrix()) @ odometry @ LIFT
    np.testing.assert_allclose(T_map_lidar[4:], moved[4:count], atol=1e-9)


def test_the_odometry_does_not_jump():
    feedback, _, _, T_map_odom = fed_back(COUNT)
    assert np.linalg.norm(T_map_odom[:3, 3]) > 0.05
    T = odometry_poses()[-1]
    found, nav, seen = feedback.in_odometry(*output_in_map(T_map_odom, T, COUNT - 1))
    np.testing.assert_allclose(found, T_map_odom, atol=1e-12)
    np.testing.assert_allclose(nav.T_world_imu.as_matrix(), T, atol=1e-12)
    np.testing.assert_allclose(nav.velocity, [1.0, 2.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(nav.gravity, [0.1, 0.2, -9.8], atol=1e-12)
    np.testing.assert_allclose(seen.registration.T_world_lidar.as_matrix(), T @ LIFT, atol=1e-12)
    np.testing.assert_allclose(seen.origin, [3.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(seen.points, np.arange(6.0).reshape(2, 3), atol=1e-5)


class Slow:
    """A back end that solves at each third keyframe, and takes its time."""

    def __init__(self, fails_at=None):
        self.solves, self.count, self.fails_at = 0, 0, fails_at

    def add(self, keyframe):
        if keyframe.index == self.fails_at:
            raise RuntimeError("out of luck")
        time.sleep(0.002 * (keyframe.index % 4))
        self.count += 1
        self.solves += keyframe.index % 3 == 0

    def settle(self):
        self.solves += 1

    def correction(self):
        return self.count


@pytest.mark.parametrize(("fails_at", "expected"), [(None, [1, None, 4, 4 + 3, 10]), (5, [1, None, 4, None])])
def test_corrections_depend_on_the_keyframes_alone(fails_at, expected):
    thread = BackEndThread(Slow(fails_at), keep_solved=True)
    for index in range(10):
        thread.add(SimpleNamespace(index=index))
    found = [thread.correction_after(index) for index in (0, 2, 4, 8, 9)]
    thread.finish()
    assert found[: len(expected)] == expected


@pytest.mark.parametrize(
    ("recipe", "sets", "sentence"),
    [
        ("default", ["config.backend.loops=true"], "this recipe matches scans with none"),
        ("lio_sam", [], "has no effect without corrections"),
    ],
)
def test_feedback_without_effect_is_refused(tmp_path, recipe, sets, sentence):
    recording = InertialReplay([], None)
    wanted = with_overrides(recipe_settings(recipe), ["config.backend.feedback=true", *sets])
    with pytest.raises(UsageError, match=sentence):
        run_sequence(recording, wanted, tmp_path)
    assert not Settings().run.backend.feedback


@pytest.fixture
def bending(monkeypatch):
    """Let the back end find a drift at two keyframes that is none: 2 % of the way, 1 degree per metre."""
    take = BackEnd.add

    def add(self, keyframe):
        take(self, keyframe)
        if keyframe.index in (3, 8):
            self._poses = bent(self._poses, 0.005)
            self.solves += 1

    monkeypatch.setattr(BackEnd, "add", add)


def small(*sets):
    """Return a recording, and settings under which it has many keyframes."""
    recording = InertialReplay(inertial_drive.scans(END - 40, END), inertial_drive.imu())
    wanted = ["config.backend.loops=true", "config.output.keyframe_distance=0.3", "config.output.map=false"]
    return recording, settings_for(recording, with_overrides(recipe_settings("lio_sam"), [*wanted, *sets]))[0]


END = 60


@pytest.mark.long
def test_a_run_with_feedback_is_smooth_repeatable_and_resumable(tmp_path, bending):
    recording, with_feedback = small("config.backend.feedback=true")
    jumps = []
    applied = Feedback.applied

    def noted(self, state, scan, pager):
        before = self._T_map_odom
        state = applied(self, state, scan, pager)
        jumps.extend([] if self._T_map_odom is before else [scan])
        return state

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Feedback, "applied", noted)
        folders, whole = killed_at(recording, with_feedback, tmp_path, (10, 34))
    assert len(jumps) == 2
    assert jumps[0] < 34
    for folder in folders:
        resumable(recording, with_feedback, folder)
        assert contents(folder) == whole
    run_sequence(recording, with_feedback, tmp_path / "again")
    assert contents(tmp_path / "again") == whole
    run_sequence(recording, small()[1], tmp_path / "without")
    plain, fed = (read_tum(tmp_path / name / "odometry.tum").poses for name in ("without", "whole"))
    steps = [np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (plain, fed)]
    lengths = [np.linalg.norm(step[:, :3, 3], axis=1) for step in steps]
    assert lengths[1].max() < lengths[0].max() + 0.03
    np.testing.assert_allclose(steps[1][:, :3, 3], steps[0][:, :3, 3], atol=0.02)


SPEED, PERIODS = 8.0, 240
"""m/s; every second scan counts, so that there are five a second."""


def lap_driven_again():
    """Return a lap of 33 s around a block, driven on, and its truth.

    No scan shows anything between 12.5 and 15.0 s, and there the gyroscope has an error of 0.15 rad/s.
    """
    scene = build("city", 0)
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * PITCH - lap()[0]
    path = rounded(corners, radius=9.0)
    poses = driven(scene.world, np.tile(path, (2, 1)), -LANE)
    way = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    stamps = EPOCH_NS + np.round(np.concatenate([[0.0], np.cumsum(way)]) / SPEED * 1e9).astype(np.int64)
    drive = SimulatedSequence(
        scene,
        duration_s=0.2 * PERIODS,
        beams=16,
        columns=512,
        imu=ImuModel(),
        trajectory=Trajectory(stamps, poses),
    )
    samples, scans = drive.imu(), [next(drive.scans(number, 1)) for number in range(1, 2 * PERIODS, 2)]
    scans = [without_points(one) if 12.5 < 0.2 * k + 0.1 < 15.0 else one for k, one in enumerate(scans)]
    seconds = (samples.stamp_ns - EPOCH_NS) * 1e-9
    gyro = samples.gyro + 0.15 * np.outer((seconds > 12.5) & (seconds < 15.0), [0.0, 0.0, 1.0])
    return InertialReplay(scans, ImuData(samples.stamp_ns, gyro, samples.accel)), drive.truth()


def late_error(trajectory, truth):
    """Return the position error of the last 2 s, m, where the first 10 s lie on the truth."""
    true = truth.at(trajectory.stamp_ns).poses
    errors = position_errors(align(trajectory.poses[:50], true[:50]), trajectory.poses, true)
    return float(np.sqrt(np.mean(errors[-10:] ** 2)))


@pytest.mark.long
def test_a_lap_driven_again_is_driven_in_its_old_map(tmp_path):
    recording, truth = lap_driven_again()
    wanted = [
        "config.backend.loops=true",
        "config.backend.feedback=true",
        "config.output.keyframe_distance=3",
        "config.output.map=false",
        "params.loop.time_gap=15",
    ]
    settings, _ = settings_for(recording, with_overrides(recipe_settings("lio_sam"), wanted))
    result = run_sequence(recording, settings, tmp_path)
    assert result.interruption is None
    odometry, online = (read_tum(tmp_path / f"{name}.tum") for name in ("odometry", "online"))
    assert late_error(odometry, truth) > 5
    assert late_error(online, truth) < 0.2 * late_error(odometry, truth)
    steps = np.linalg.norm(np.diff(odometry.positions, axis=0), axis=1)
    jumps = np.linalg.norm(np.diff(online.positions, axis=0), axis=1)
    assert steps.max() < 0.2 * SPEED + 0.2
    assert jumps.max() > 2
