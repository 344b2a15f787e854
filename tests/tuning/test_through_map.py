"""Gradients through the map, against central differences of whole runs in which nothing is held.

The runs are in double precision, the map included, and the steps are so small that no point changes its cell
or its plane.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax import gradient
from lio_jax.core.errors import UsageError
from lio_jax.mapping.voxel_map import empty_map
from lio_jax.recipes import RECIPES, lidar_inertial, lidar_odometry
from lio_jax.run.track import Compiled, run_steps
from lio_jax.settings.settings import recipe_of
from lio_jax.tuning.gradient import wants_map
from lio_jax.tuning.objectives import Observed, objective_named
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.reverse import checkpointed_gradient
from lio_jax.tuning.streaming import streaming_gradient
from tests.tuning.recordings import TIGHT, DoubleRecording, drive, settings
from tests.tuning.test_streaming import Everything

# a capacity of its own: programs are kept by the config, and these have another map
WIDE = [*TIGHT, "config.map.capacity=16384"]
FREE = ("lidar.range_sigma", "lidar.surface_sigma", "registration.kernel", "extrinsics.*", "imu.*_noise")
SCANS = 8


@pytest.fixture
def double_map(monkeypatch):
    for recipe in (lidar_inertial, lidar_odometry):
        monkeypatch.setattr(recipe, "empty_map", partial(empty_map, dtype=jnp.float64))


def total(chosen, params, recording):
    own, objective, sums = Compiled(recipe_of(chosen), params), Everything(), jnp.zeros(())
    for fed, state, output in run_steps(own, recording.scan_inputs()):
        sums = objective.add(sums, Observed.of(state, output), recording.truth_at(fed.end_ns))
    return float(sums)


@pytest.mark.long
@pytest.mark.parametrize("inertial", [True, False])
def test_gradients_through_the_map_agree_with_differences_of_whole_runs(inertial, double_map):
    chosen = settings("default", inertial, *WIDE)
    recording = DoubleRecording(drive(), chosen, 0, SCANS)
    known = set(free_parameters(chosen.params(), ["*"]).paths)
    patterns = [one for one in FREE if inertial or not one.startswith("imu")]
    free = free_parameters(chosen.params(), patterns)
    assert set(free.paths) <= known
    x = np.asarray(free.first())
    about = recipe_of(chosen), free, Everything(), jnp.asarray(x), recording
    result = streaming_gradient(*about, through_map=True)
    assert not result.unconverged
    still = streaming_gradient(*about)
    backward = checkpointed_gradient(*about, every=3, through_map=True)
    np.testing.assert_allclose(backward.gradient, result.gradient, rtol=1e-6, atol=1e-9)
    for component, name in enumerate(free.names):
        step = 1e-7 if name.startswith("extrinsics") else 1e-6
        high, low = (
            total(chosen, free(x + sign * step * (np.arange(len(x)) == component)), recording)
            for sign in (1, -1)
        )
        difference = (high - low) / (2 * step)
        assert result.gradient[component] == pytest.approx(difference, rel=1e-4, abs=2e-10 / step), name
    # the test would see a map that is held: by the lever arm its derivative is tens of times too large
    arms = [component for component, name in enumerate(free.names) if "extrinsics.translation" in name]
    assert np.all(np.abs(still.gradient[arms]) > 10 * np.abs(result.gradient[arms]))


def test_a_gradient_goes_through_the_map_where_that_matters():
    def wants(objective, *patterns):
        return wants_map(
            objective_named(objective), free_parameters(RECIPES["default"].params_type(), patterns)
        )

    assert wants("ate", "imu.*_noise")
    assert wants("map", "extrinsics.*")
    assert wants("ate+0.01*pose", "imu.*_noise")
    assert wants("noise", "imu.*_noise", "extrinsics.*")
    assert not wants("noise", "imu.*_noise", "lidar.range_sigma")


def test_recipes_say_whether_they_are_differentiated_through_the_map():
    chosen = settings("fast_lio2", True)
    with pytest.raises(UsageError, match="fast_lio2 takes its map as a constant"):
        gradient(drive(), ["imu.gyro_noise"], "ate", chosen, count=2, through_map=True)
