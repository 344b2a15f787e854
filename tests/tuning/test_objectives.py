"""Running sums against evo's metrics and numpy, and derivatives of the alignment."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.core.types import initial_nav_state
from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.evaluate import evaluate
from lio_jax.tuning import objective_names, objectives
from lio_jax.tuning.objectives import (
    AbsoluteError,
    MarginalLikelihood,
    MeanOverScans,
    Observed,
    RelativeError,
    TruePose,
    WeightedSum,
    objective_named,
)

COUNT = 40


def poses(seed, noise=0.0):
    """Return (n, 7) wxyz_xyz along a curve, shaken by ``noise``."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 3, COUNT)
    position = np.stack([5 * time, np.sin(2 * time), 0.2 * time**2], 1) + noise * rng.normal(size=(COUNT, 3))
    turn = np.stack([0.1 * time, 0.05 * time, 0.7 * time], 1) + noise * rng.normal(size=(COUNT, 3))
    wxyz = jax.vmap(lambda w: jaxlie.SO3.exp(w).wxyz)(jnp.asarray(turn))
    return jnp.concatenate([wxyz, jnp.asarray(position)], 1)


def seen_at(pose, lost=False):
    nav = initial_nav_state(jaxlie.SE3.identity())
    nav = dataclasses.replace(nav, T_world_imu=jaxlie.SE3(pose))
    return Observed(nav, jnp.array(0.1), jnp.array(1e-6), jnp.int32(0), jnp.array(lost), None, None, None)


def loss(objective, estimate, truth, known=None):
    sums = objective.start()
    for k in range(COUNT):
        true = TruePose(jaxlie.SE3(truth[k]), jnp.array(True if known is None else bool(known[k])))
        sums = objective.add(sums, seen_at(estimate[k]), true)
    return objective.value(sums)


def trajectory(rows):
    stamps = np.arange(COUNT) * 100_000_000
    return Trajectory(stamps, np.asarray(jax.vmap(lambda row: jaxlie.SE3(row).as_matrix())(rows)))


def test_absolute_error_is_that_of_evo():
    estimate, truth = poses(0, 0.05), poses(1)
    expected = evaluate(trajectory(estimate), trajectory(truth)).as_dict()["ate"]["rmse"]
    assert float(loss(AbsoluteError(), estimate, truth)) == pytest.approx(expected, rel=1e-9)


def test_relative_error_is_that_of_its_definition():
    estimate, truth = poses(0, 0.05), poses(1)
    p, q = trajectory(estimate).poses, trajectory(truth).poses
    errors = [
        np.linalg.inv(np.linalg.inv(q[k]) @ q[k + 10]) @ np.linalg.inv(p[k]) @ p[k + 10]
        for k in range(COUNT - 10)
    ]
    moved = np.sqrt(np.mean([error[:3, 3] @ error[:3, 3] for error in errors]))
    turned = np.sqrt(
        np.mean([np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)) ** 2 for error in errors])
    )
    assert float(loss(RelativeError(), estimate, truth)) == pytest.approx(moved, rel=1e-9)
    assert float(loss(RelativeError(rotation=True), estimate, truth)) == pytest.approx(turned, rel=1e-6)


@pytest.mark.parametrize("objective", [AbsoluteError(), RelativeError()], ids=["ate", "rpe"])
@pytest.mark.parametrize("flat", [False, True], ids=["curve", "in a plane"])
def test_derivatives_agree_with_central_differences(objective, flat):
    estimate, truth = poses(0, 0.05), poses(1)
    if flat:
        truth = truth.at[:, 6].set(0.0)
    direction = jnp.zeros_like(estimate).at[:, 4:].set(np.random.default_rng(2).normal(size=(COUNT, 3)))

    def along(t):
        return loss(objective, estimate + t * direction, truth)

    step = 1e-6
    expected = (along(step) - along(-step)) / (2 * step)
    assert float(jax.jvp(along, (0.0,), (1.0,))[1]) == pytest.approx(float(expected), rel=1e-6)


def test_poses_without_truth_do_not_count():
    estimate, truth = poses(0, 0.05), poses(1)
    known = np.arange(COUNT) < 25
    broken = truth.at[25:, 4:].set(1e3)
    whole = loss(AbsoluteError(), estimate, broken, known)
    sums = AbsoluteError().start()
    for k in range(25):
        sums = AbsoluteError().add(
            sums, seen_at(estimate[k]), TruePose(jaxlie.SE3(truth[k]), jnp.array(True))
        )
    assert float(whole) == pytest.approx(float(AbsoluteError().value(sums)), rel=1e-12)


def mean_of(losses, lost, skip=0, scale=1.0):
    """Return the mean of made losses; ``lost`` says which scans could not be matched."""
    mean = MeanOverScans(lambda seen, truth: seen.nav.T_world_imu.translation()[0] * scale, skip)
    sums, truth = mean.start(), TruePose(jaxlie.SE3.identity(), jnp.array(False))
    for one, gone in zip(losses, lost, strict=True):
        sums = mean.add(sums, seen_at(jnp.array([1.0, 0, 0, 0, one, 0, 0]), gone), truth)
    return mean.value(sums)


def test_the_mean_charges_lost_scans_as_the_worst_and_leaves_out_the_opening():
    found = mean_of(range(6), [True, False, False, False, True, False], skip=2)
    assert float(found) == pytest.approx((2 + 3 + 5 + 5) / 4)


def test_parameters_that_lose_hard_scans_are_worse_than_those_that_match_them():
    losses = [1.0, 2.0, 9.0, 1.0, 8.5, 8.0]
    matched = mean_of(losses, [False] * 6)
    assert mean_of(losses, [False] * 4 + [True, True]) > matched
    assert mean_of([loss - 10 for loss in losses], [False] * 4 + [True, True]) > matched - 10
    assert mean_of(losses, [True] * 6) == np.inf


def test_a_lost_scan_is_a_constant_of_the_derivative_of_the_mean():
    losses, lost = [1.0, 2.0, 9.0, 4.0], [False, False, False, True]
    for derivative in (jax.grad, jax.jacfwd):
        slope = derivative(lambda scale: mean_of(losses, lost, scale=scale))(1.0)
        assert float(slope) == pytest.approx((1 + 2 + 9) / 4)
    none = jax.grad(lambda scale: mean_of(losses, [True] * 4, scale=scale))(1.0)
    assert float(none) == 0.0


def test_the_mean_of_a_recording_shorter_than_the_opening_is_zero():
    assert float(mean_of([1.0, 2.0], [False, True], skip=2)) == 0.0


def test_sums_of_objectives_by_name():
    estimate, truth = poses(0, 0.05), poses(1)
    named = objective_named("ate+0.5*rpe")
    assert named.needs_truth
    assert not named.likelihood
    assert isinstance(named.objective, WeightedSum)
    expected = loss(AbsoluteError(), estimate, truth) + 0.5 * loss(RelativeError(), estimate, truth)
    assert float(loss(named.objective, estimate, truth)) == pytest.approx(float(expected))
    assert objective_named("noise").likelihood


def test_the_listed_names_are_those_of_the_objectives():
    assert set(objectives._SINGLE) == set(objective_names.SINGLE)
    likelihoods = {name for name, named in objectives._SINGLE.items() if named.likelihood}
    assert likelihoods == set(objective_names.LIKELIHOODS)
    for text in (*objective_names.SHORT, objective_names.EXAMPLE):
        objective_named(text)


@pytest.mark.parametrize("text", ["atte", "ate+rpf", "x*ate"])
def test_an_unknown_objective_lists_those_there_are(text):
    with pytest.raises(UsageError, match=r"there are: noise, pose|is no number"):
        objective_named(text)


@pytest.mark.parametrize("name", ["pose", "point"])
def test_innovations_want_a_filter(name):
    with pytest.raises(UsageError, match="ate, rpe or map"):
        loss(MeanOverScans(objective_named(name).objective.loss), poses(0), poses(1))


def test_the_range_noise_needs_the_scan():
    with pytest.raises(UsageError, match="needs the scan"):
        loss(objective_named("ranges").objective, poses(0), poses(1))


def test_the_marginal_likelihood_is_what_the_scans_after_the_opening_add():
    totals = np.cumsum(np.random.default_rng(4).normal(30, 5, COUNT))
    truth = TruePose(jaxlie.SE3(poses(1)[0]), jnp.array(True))
    objective = MarginalLikelihood(skip=10)
    sums = objective.start()
    for number, total in enumerate(totals):
        seen = dataclasses.replace(seen_at(poses(0)[number]), log_evidence=jnp.asarray(total))
        sums = objective.add(sums, seen, truth)
    expected = -(totals[-1] - totals[9]) / (COUNT - 10)
    assert float(objective.value(sums)) == pytest.approx(expected, rel=1e-12)


def test_a_recipe_without_a_smoother_has_no_marginal_likelihood():
    objective = objective_named("marginal").objective
    with pytest.raises(UsageError, match=r"no smoother.*use lio_sam, or pose"):
        objective.add(
            objective.start(),
            seen_at(poses(0)[0]),
            TruePose(jaxlie.SE3(poses(1)[0]), jnp.array(True)),
        )
