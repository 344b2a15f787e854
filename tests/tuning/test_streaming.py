"""Streaming gradients against central differences; the recipes' own are in one file each."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.leaf import settings_of
from lio_jax.recipes import RECIPES
from lio_jax.recipes.recipe import Recipe
from lio_jax.run.compiled import Compiled
from lio_jax.run.track import run_steps
from lio_jax.settings.settings import recipe_of
from lio_jax.tuning.objectives import MarginalLikelihood, Observed
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.reverse import checkpointed_gradient
from lio_jax.tuning.streaming import objective_values, streaming_gradient
from tests.tuning.recordings import SCANS, TIGHT, DoubleRecording, drive, settings

STEPS = {
    "imu.gyro_bias_walk": 1e-3,
    "imu.accel_bias_walk": 1e-3,
    "imu.gravity": 1e-6,
    "where points lie": 1e-8,
    "": 1e-5,
}
"""Steps: small where points move, so that they keep their planes; large where the effect is small."""
NOISE = 2e-10
"""Noise as a share of a total: solves end at a step of 1e-12 and not of 0."""
SMOOTHER_STEPS = {
    **STEPS,
    "imu.gyro_noise": 3e-3,
    "imu.accel_noise": 3e-3,
    "imu.gyro_bias_walk": 1e-2,
    "imu.accel_bias_walk": 1e-2,
    "imu.gravity": 1e-5,
    "where points lie": 1e-6,
    # their lever arm is the range
    "lidar.elevation_offset": 1e-8,
    "lidar.range_scale": 1e-8,
}
SMOOTHER_NOISE = 1e-8
"""Information of states that spans sixteen orders of magnitude leaves fewer digits."""


class Everything(eqx.Module):
    """Weighs all that a scan leaves to see: trajectory, velocity, biases, a filter's covariance, innovations.

    A smoother's covariance keeps eight digits, too few for differences; its derivatives and those of its
    evidence are tested where no points are matched.
    """

    def start(self):
        return jnp.zeros(())

    def add(self, sums, seen, truth):
        smooth = [
            seen.nav.T_world_imu.wxyz_xyz,
            seen.nav.velocity,
            10 * seen.nav.gyro_bias,
            seen.nav.accel_bias,
            seen.nav.gravity,
            seen.rmse[None],
        ]
        if seen.evidence is not None:
            # by a third, or the weights let the parts' derivatives by the angle's noise cancel each other
            smooth.append(jnp.log(jnp.diagonal(seen.covariance)[:15] + 1e-9) / 3)
            smooth.append(-0.01 * seen.evidence.innovation.log_likelihood()[None])
        values = jnp.concatenate(smooth)
        return sums + values @ jnp.sin(1.0 + jnp.arange(len(values)))

    def value(self, sums):
        return sums


class HeldMap:
    """A stepper that sees the maps of another run instead of its own."""

    def __init__(self, chosen, params, maps):
        self.own = Compiled(recipe_of(chosen), params)
        self.maps = [] if maps is None else maps.maps
        self.replayed = maps is not None
        self.count = 0

    def init(self, imu, velocity=None):
        return self.own.init(imu, velocity)

    def step(self, state, scan, imu):
        if not self.replayed:
            self.maps.append(jax.tree.map(jnp.copy, state.map))
        state = eqx.tree_at(lambda tree: tree.map, state, jax.tree.map(jnp.copy, self.maps[self.count]))
        self.count += 1
        return self.own.step(state, scan, imu)


def total(held, recording):
    objective, sums = Everything(), jnp.zeros(())
    for fed, state, output in run_steps(held, recording.scan_inputs()):
        sums = objective.add(sums, Observed.of(state, output), recording.truth_at(fed.end_ns))
    return float(sums)


NOT_SMOOTH = {("fast_lio2", False)}
"""Averaging and gating after motion compensation by the estimated velocity jump with any step, however small:
central differences see the jumps."""
NOT_POSSIBLE = {("lio_sam", False)}
"""Its smoother lives on inertial samples."""
CASES = [
    (recipe, inertial)
    for recipe in RECIPES
    for inertial in (True, False)
    if (RECIPES[recipe].needs.imu != "unused" or not inertial) and (recipe, inertial) not in NOT_POSSIBLE
]


BY_RECIPE = {
    name: [inertial for recipe, inertial in CASES if recipe == name and (name, inertial) not in NOT_SMOOTH]
    for name in RECIPES
}


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_has_a_file_of_its_own(recipe):
    """So that the worker processes share the long differences."""
    assert BY_RECIPE[recipe]
    assert Path(__file__).with_name(f"test_streaming_{recipe}.py").is_file()


def differentiable(recipe: Recipe) -> list[str]:
    """Return the paths of a recipe's parameters that have a derivative."""
    return [path for path, setting in settings_of(recipe.params_type).items() if setting.declared.tuned]


def check_gradients(recipe: str, inertial: bool) -> None:
    """Gradients of every leaf agree with central differences."""
    # the features of a coarser scan leave a direction open, and the derivative holds it constant
    driven = drive(columns=512 if recipe == "lio_sam" else 256)
    chosen = settings(recipe, inertial, *TIGHT, of=driven)
    recording = DoubleRecording(driven, chosen)
    free = free_parameters(chosen.params(), differentiable(recipe_of(chosen)))
    assert set(free.paths) == set(differentiable(recipe_of(chosen)))
    x = np.asarray(free.first())
    result = streaming_gradient(recipe_of(chosen), free, Everything(), jnp.asarray(x), recording)

    nominal = HeldMap(chosen, chosen.params(), None)
    # two programs round differently, and so do the maps they build
    assert total(nominal, recording) == pytest.approx(result.value, rel=1e-5)
    assert not result.unconverged
    steps, noise = (SMOOTHER_STEPS, SMOOTHER_NOISE) if recipe == "lio_sam" else (STEPS, NOISE)
    # a total's rounding grows with it
    noise *= max(1.0, abs(result.value))
    wrong = {}
    for component, (name, declared) in enumerate(zip(free.names, free.declared, strict=True)):
        step = steps.get(name, steps["where points lie" if declared.moves_points else ""])
        ends = [x + sign * step * (np.arange(len(x)) == component) for sign in (1, -1)]
        high, low = (total(HeldMap(chosen, free(end), nominal), recording) for end in ends)
        difference = (high - low) / (2 * step)
        if result.gradient[component] != pytest.approx(difference, rel=1e-4, abs=noise / step):
            wrong[name] = result.gradient[component], difference
    assert not wrong


@pytest.mark.long
def test_the_marginal_likelihood_has_a_derivative_by_every_leaf():
    """Finite, and none where the smoother and its scan matches have no part in it."""
    chosen = settings("lio_sam", True, *TIGHT)
    recording = DoubleRecording(drive(), chosen, 0, 8)
    free = free_parameters(chosen.params(), differentiable(recipe_of(chosen)))
    result = streaming_gradient(recipe_of(chosen), free, MarginalLikelihood(3), free.first(), recording)
    assert np.isfinite(result.value)
    assert np.isfinite(result.scores).all()
    by_name = dict(zip(free.names, result.gradient, strict=True))
    # loose matches of half a second tell little of the samples' noise
    assert by_name["imu.gyro_noise"] != 0
    assert by_name["imu.accel_noise"] != 0
    assert abs(by_name["registration.information_scale"]) > 1e-3
    # the recipe does not read it
    assert "lidar.angle_sigma" not in by_name


FEW = ("imu.gyro_noise", "imu.accel_noise", "lidar.range_sigma", "extrinsics.*")


@pytest.mark.long
def test_reverse_mode_and_a_batch_of_parameters_give_the_same_numbers():
    chosen = settings("default", True, *TIGHT)
    recording = DoubleRecording(drive(), chosen)
    free = free_parameters(chosen.params(), FEW)
    x = np.asarray(free.first())
    objective = recipe_of(chosen), free, Everything()
    streamed = streaming_gradient(*objective, jnp.asarray(x), recording)
    value, gradient, _ = checkpointed_gradient(*objective, jnp.asarray(x), recording, every=9)
    assert value == pytest.approx(streamed.value, rel=1e-5)
    np.testing.assert_allclose(gradient, streamed.gradient, rtol=1e-4)
    np.testing.assert_allclose(streamed.scores.sum(0), streamed.gradient, rtol=1e-9)
    assert streamed.scores.shape == (SCANS, len(x))

    shifted = x + np.array([0.3, -0.2, 0.1, *np.zeros(7)])
    alone = streaming_gradient(*objective, jnp.asarray(shifted), recording).value
    values = objective_values(*objective, jnp.stack([x, shifted]), recording)
    np.testing.assert_allclose(values, [streamed.value, alone], rtol=1e-4)


@pytest.mark.long
def test_a_solve_that_does_not_converge_is_flagged():
    chosen = settings("default", True, *TIGHT, "config.registration.max_iterations=2")
    recording = DoubleRecording(drive(), chosen, 0, 6)
    free = free_parameters(chosen.params(), ["imu.gyro_noise"])
    objective = recipe_of(chosen), free, Everything()
    result = streaming_gradient(*objective, free.first(), recording)
    assert result.unconverged == tuple(range(1, 6))
