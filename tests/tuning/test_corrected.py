"""Objectives of the trajectory after loops and GPS: values and derivatives against the back end itself."""

from functools import cache

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import UsageError
from lio_jax.loops.back_end import BackEnd, corrected_poses
from lio_jax.loops.edge_noise import loop_covariance, odometry_covariance
from lio_jax.loops.gps import GpsGate
from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.proposals import Proposal
from lio_jax.loops.verification import Verdict
from lio_jax.pose_graph.graph import matrices_of
from lio_jax.settings.settings import recipe_settings, with_overrides
from lio_jax.tuning.corrected import (
    CorrectedRun,
    corrected_gradient,
    corrected_value,
    free_of_back_end,
    names_back_end,
)
from lio_jax.tuning.objectives import TruePose, objective_named
from lio_jax.tuning.replayed_graph import replayed_graph
from tests.loops.drives import LEVER, poses_at, to_enu
from tests.tuning.test_objectives import seen_at

COUNT = 60
SECONDS = np.arange(2 * COUNT - 1) / 20
STAMPS = np.round(SECONDS * 1e9).astype(np.int64)
TRUTH = poses_at(SECONDS, turning=0.3)
"""Every second pose is a keyframe."""
PATTERNS = ["loop.*", "gps.*", "backend.*"]


def noisy(poses, sigma, rng):
    """Return poses with right perturbations."""
    wrong = np.tile(np.eye(4), (len(poses), 1, 1))
    wrong[:, :3, :3] = Rotation.from_rotvec(sigma / 10 * rng.normal(size=(len(poses), 3))).as_matrix()
    wrong[:, :3, 3] = sigma * rng.normal(size=(len(poses), 3))
    return poses @ wrong


def stated(scale, rng):
    root = np.array([1e-1] * 3 + [1.0] * 3)[:, None] * rng.normal(size=(6, 8))
    return scale**2 * root @ root.T


class Loops:
    """Five loops that a closer would have found, with errors; the last one is wrong."""

    def __init__(self, limits, rng):
        self.found = []
        for source in range(35, 60, 5):
            target = source - 33
            T = noisy((np.linalg.inv(TRUTH[2 * target]) @ TRUTH[2 * source])[None], 0.1, rng)[0]
            own = stated(0.05, rng)
            information = np.linalg.inv(
                loop_covariance(own, limits["rotation_sigma"], limits["translation_sigma"])
            )
            T = T if source < 55 else np.eye(4)
            proposal = Proposal(source, target, "radius", T, 1.0, 0.1, 1.0)
            self.found.append(Verdict(proposal, True, "", T, information, own))

    def take(self, keyframes, poses):
        return [one for one in self.found if one.proposal.source == len(keyframes) - 1]

    def outcomes(self):
        return self.found


@cache
def run(fixes: bool, elevation: bool = True):
    """Return settings, the back end's correction and the replayed run of a short drive."""
    rng = np.random.default_rng(3)
    overrides = ["config.backend.loops=true", "params.gps.min_variance=0.05", "params.gps.yaw_sigma=0.5"]
    overrides += [
        f"params.gps.lever_arm={(LEVER + 0.2).tolist()}",
        f"config.backend.gps_elevation={elevation}",
    ]
    settings = with_overrides(recipe_settings("default"), [one.replace("True", "true") for one in overrides])
    values = settings.values
    steps = noisy(np.linalg.inv(TRUTH[:-1]) @ TRUTH[1:], 0.03, rng)
    poses = [TRUTH[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    odometry = np.array(poses)
    gate = None
    if fixes:
        antennas = TRUTH[::2, :3, :3] @ LEVER + TRUTH[::2, :3, 3]
        positions = to_enu(antennas) + 0.2 * rng.normal(size=antennas.shape)
        # some of the variances are below the least one
        covariance = np.tile(np.diag([0.02, 0.09, 0.2]) + 0.01, (COUNT, 1, 1))
        gate = GpsGate(STAMPS[::2], positions, covariance, values["gps"], elevation)
    back_end = BackEnd(settings, Loops(values["loop"], rng), gate)
    sigmas = [
        values["backend"][f"odometry_{name}"] for name in ("rotation_sigma", "translation_sigma", "scale")
    ]
    none = np.zeros((0, 3), np.float32)
    for k in range(COUNT):
        own = None if k == 20 else stated(0.01, rng)
        covariance = np.diag([1e-2] * 3 + [1.0] * 3) if own is None else odometry_covariance(own, *sigmas)
        back_end.add(Keyframe(k, int(STAMPS[2 * k]), odometry[2 * k], none, covariance, own))
    back_end.settle()
    found = back_end.correction()
    poses = [
        np.concatenate([Rotation.from_matrix(T[:3, :3]).as_quat()[[3, 0, 1, 2]], T[:3, 3]]) for T in TRUTH
    ]
    truth = tuple(TruePose(jaxlie.SE3(jnp.asarray(pose)), jnp.array(True)) for pose in poses)
    seen = tuple(seen_at(jnp.asarray(pose)) for pose in poses)
    replayed = replayed_graph(found, STAMPS, odometry, elevation)
    expected = corrected_poses(STAMPS, odometry, found.stamp_ns, found.T_odom_imu, found.T_world_imu)
    return settings, found, CorrectedRun(seen, truth, replayed, 5, 0), expected


@pytest.mark.long
@pytest.mark.parametrize(
    "fixes", [pytest.param(False, marks=pytest.mark.long), True], ids=["loops", "loops and fixes"]
)
def test_the_replayed_trajectory_is_that_of_the_back_end(fixes):
    settings, found, replay, expected = run(fixes)
    free = free_of_back_end(settings, PATTERNS, objective_named("ate"))
    assert (found.weights < 0.5).any()
    assert (found.T_enu_world is not None) == fixes
    poses = matrices_of(jaxlie.SE3(replay.replayed.corrected(free(free.first()))))
    np.testing.assert_allclose(poses, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("objective", "fixes", "elevation"),
    [
        pytest.param("ate", False, True, marks=pytest.mark.long),
        pytest.param("ate+rpe", True, True, marks=pytest.mark.long),
        pytest.param("ate", True, False, marks=pytest.mark.long),
    ],
    ids=["loops", "loops and fixes", "heights of the odometry"],
)
def test_derivatives_are_central_differences(objective, fixes, elevation):
    settings, _, replay, _ = run(fixes, elevation)
    named = objective_named(objective)
    free = free_of_back_end(settings, PATTERNS, named)
    x = free.first()
    value, gradient = corrected_gradient(replay, free, named.objective, x)
    assert value == pytest.approx(corrected_value(replay, free, named.objective, x), rel=1e-9)
    by_name = dict(zip(free.names, gradient, strict=True))
    moved = {"loop.rotation_sigma", "loop.translation_sigma", "backend.odometry_scale"}
    moved |= {"gps.lever_arm.x", "gps.lever_arm.y", "gps.min_variance"} if fixes else set()
    for number, name in enumerate(free.names):
        # of fourth order: a shorter step of second order shows the rounding of the solve
        step = jnp.zeros_like(x).at[number].set(4e-3)
        ends = [corrected_value(replay, free, named.objective, x + k * step) for k in (-2, -1, 1, 2)]
        expected = np.dot(ends, [1, -8, 8, -1]) / (12 * 4e-3)
        assert by_name[name] == pytest.approx(expected, rel=1e-4, abs=1e-8 * value), name
        assert name not in moved or abs(expected) > 1e-6 * value, name


@pytest.mark.parametrize(
    ("patterns", "overrides", "named", "words"),
    [
        (["loop.*"], [], "ate", "without the back end"),
        (["gps.lever_arm", "imu.*"], ["config.backend.gps=true"], "ate", "one after the other"),
        (["loop.*"], ["config.backend.loops=true"], "noise", "take the objective ate"),
        (["loop.radius"], ["config.backend.loops=true"], "ate", "has no derivative"),
        (
            ["backend.*"],
            ["config.backend.loops=true", "config.backend.feedback=true"],
            "ate",
            "config.backend.feedback=true out",
        ),
    ],
)
def test_what_cannot_be_tuned_is_refused(patterns, overrides, named, words):
    settings = with_overrides(recipe_settings("default"), overrides)

    def free():
        names_back_end(patterns, settings)
        free_of_back_end(settings, patterns, objective_named(named))

    with pytest.raises(UsageError, match=words):
        free()


def test_patterns_of_the_recipe_are_not_of_the_back_end():
    settings = with_overrides(recipe_settings("default"), ["config.backend.loops=true"])
    assert not names_back_end(["imu.*", "*"], settings)
    assert names_back_end(["params.loop.*", "gps.*"], settings)
