"""Every recipe finds its velocity from the first scans, at any speed."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.types import ImuBatch
from lio_jax.data.detect import open_sequence
from lio_jax.recipes.transforms import split_smooth, with_first_velocity
from lio_jax.run.track import scan_inputs
from lio_jax.settings.settings import Settings, recipe_of, with_overrides
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.reverse import _pull_init
from tests.run.roads import relative, road, steps, tracked
from tests.shared_data import SHARED_DATA, needs_shared

DRIVE = SHARED_DATA / "kitti_raw" / "2011_09_26" / "2011_09_26_drive_0015_sync"
WITHOUT = ("config.imu.use=false",)
LONG = [pytest.param(name, (), marks=pytest.mark.long) for name in ("lio_sam", "loam")]
CASES = [("default", ()), ("default", WITHOUT), ("fast_lio2", ()), *LONG]


@needs_shared
@pytest.mark.parametrize(("recipe", "overrides"), CASES)
def test_a_real_drive_at_17_metres_a_second_is_followed_from_the_first_scan(recipe, overrides):
    sequence = open_sequence(DRIVE)
    _, results = tracked(sequence, recipe, overrides, scans=sequence.scans(0, 20))
    poses, truth = relative(results, sequence)
    assert steps(truth).min() > 1.6
    # the stamps of this drive's poses jitter by 10 ms: over three scans the speeds compare
    np.testing.assert_allclose(steps(poses)[:3].sum(), steps(truth)[:3].sum(), rtol=0.05)
    np.testing.assert_allclose(steps(poses).sum(), steps(truth).sum(), rtol=0.03)


@pytest.mark.parametrize(("recipe", "overrides"), CASES)
@pytest.mark.parametrize(("speed", "turn"), [(35.0, 0.5)])
def test_a_simulated_street_is_followed_at_any_speed(recipe, overrides, speed, turn):
    sequence = road("street", speed, turn, 8)
    _, results = tracked(sequence, recipe, overrides)
    poses, truth = relative(results, sequence)
    np.testing.assert_allclose(steps(poses)[2:], steps(truth)[2:], rtol=0.05)
    assert np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]) < 0.05 * steps(truth).sum()


@pytest.mark.parametrize("imu", [True, False])
def test_the_first_velocity_is_found_on_a_motorway_where_nearly_all_points_lie_on_the_ground(imu):
    sequence = road("motorway", 35.0, 0.5, 8, imu=imu)
    _, second = list(scan_inputs(Settings(), sequence.scans(0, 2), None))
    assert second.first_velocity is not None
    # the lidar's own axes: it is mounted with a yaw of 2.5 degrees
    assert np.linalg.norm(second.first_velocity) == pytest.approx(35.0, rel=0.03)


@pytest.mark.parametrize("seed", range(5))
def test_a_dozen_posts_and_trees_show_the_first_velocity(seed):
    sequence = road("motorway", 15.0, 0.0, 8, seed)
    _, second = list(scan_inputs(Settings(), sequence.scans(0, 2), None))
    assert second.first_velocity is not None
    assert np.linalg.norm(second.first_velocity) == pytest.approx(15.0, rel=0.05)


def test_a_velocity_of_the_settings_is_taken_as_it_is():
    sequence = road("street", 25.0, 0.0, 8)
    given = with_overrides(Settings(), ["params.initial.velocity=[24.0,0,0]"])
    assert all(fed.first_velocity is None for fed in scan_inputs(given, sequence.scans(0, 3), None))
    _, results = tracked(sequence, "default", ["params.initial.velocity=[24.0,0,0]"])
    poses, truth = relative(results, sequence)
    np.testing.assert_allclose(steps(poses)[2:], steps(truth)[2:], rtol=0.05)


def test_the_state_of_the_first_scan_has_the_velocity_that_the_second_one_shows():
    sequence = road("street", 25.0, 0.0, 8)
    _, results = tracked(sequence, "default")
    assert np.linalg.norm(results[0].nav.velocity) == pytest.approx(25.0, rel=0.05)


@pytest.mark.parametrize(("sigma", "slope"), [(10.0, 0.0), (0.2, 0.2)])
def test_the_derivative_knows_which_sigma_of_the_first_velocity_holds(sigma, slope):
    """What two scans show is as sure as 0.3 m/s, unless the settings are surer; the parameter is a log."""
    settings = with_overrides(Settings(), [f"params.initial.velocity_sigma={sigma}"])
    free = free_parameters(settings.params(), ["initial.velocity_sigma"])
    shown = np.array([3.0, 0.0, 0.0])
    forward = with_first_velocity(free.with_tangents(free.first()), shown)
    np.testing.assert_array_equal(forward.value.initial.velocity, shown)
    assert forward.value.initial.velocity_sigma == pytest.approx(min(sigma, 0.3))
    np.testing.assert_allclose(forward.dot.initial.velocity_sigma, [slope], rtol=1e-6)
    recipe, split = recipe_of(settings), free.split(settings.params())
    still = jnp.tile(jnp.array([0.0, 0.0, 9.81]), (20, 1))
    imu = ImuBatch(jnp.linspace(-0.1, 0.0, 20), jnp.zeros((20, 3)), still, jnp.ones(20, bool))
    bar = jax.tree.map(jnp.ones_like, split_smooth(recipe.init(settings.params(), imu), False)[0])
    pulled = jax.jit(partial(_pull_init, recipe, False))(split, imu, shown, bar)
    assert (pulled.initial.velocity_sigma != 0) == (slope != 0)
