"""Registration in analytic scenes: known poses are found, and unobservable directions are reported."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, LOST
from lio_jax.mapping.voxel_map import empty_map
from lio_jax.registration.gauss_newton import Registration, gauss_newton
from lio_jax.registration.voxel_planes import ScanToVoxels
from tests.registration.scenes import (
    POLES_AND_WALLS,
    ROOM,
    box_room,
    map_of,
    matrix,
    params_with,
    pose,
    pose_error,
    sample,
    seen_from,
)

NOISE, POINTS = 0.02, 2000
PARAMS = params_with(lidar__range_sigma=0.03)
SCENES = {"room": ROOM, "poles and walls": POLES_AND_WALLS}
MAPS = {name: map_of(sample(scene, 40000, NOISE, seed=0), PARAMS) for name, scene in SCENES.items()}
TRUTH = pose([0.4, -0.3, 0.2], [0.03, -0.02, 0.25])


def register(vmap, points_at, mask, prediction, error, params, max_iterations) -> Registration:
    match = ScanToVoxels(
        points_at=points_at,
        T_predicted=prediction,
        registration=params.registration,
        map=vmap,
        mask=mask,
        prediction_error=error,
        map_params=params.map,
        lidar=params.lidar,
    )
    return gauss_newton(match, max_iterations)


@partial(jax.jit, static_argnums=6)
def _solve(vmap, points, mask, prediction, error, params, max_iterations) -> Registration:
    return register(vmap, lambda _: points, mask, prediction, error, params, max_iterations)


def solve(vmap, points, prediction, error=0.1, params=PARAMS, max_iterations=60, mask=None) -> Registration:
    mask = jnp.ones(len(points), bool) if mask is None else jnp.asarray(mask)
    return _solve(vmap, points, mask, prediction, jnp.float64(error), params, max_iterations)


def scan_of(scene: str, seed: int, noise=NOISE) -> jax.Array:
    return seen_from(TRUTH, sample(SCENES[scene], POINTS, noise, seed, reach=25.0))


def perturbed(metres: float, degrees: float, seed: int):
    """Return the true pose, off by so much in a random direction."""
    rng = np.random.default_rng(seed)
    turn, move = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return TRUTH @ pose(metres * move, np.deg2rad(degrees) * turn)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("metres", "degrees", "prediction_error"),
    [(0.0, 0.0, 0.1), (0.05, 1.0, 0.1), (0.3, 2.0, 0.5), (1.0, 3.0, 2.0)],
)
@pytest.mark.parametrize("scene", SCENES)
def test_known_pose_comes_back(scene, metres, degrees, prediction_error, seed):
    start = perturbed(metres, degrees, seed)
    result = solve(MAPS[scene], scan_of(scene, seed + 1), start, prediction_error)
    moved, turned = pose_error(result.T_world_lidar, TRUTH)
    assert result.status == CONVERGED
    assert moved < 0.03
    assert turned < 0.2
    assert not result.degenerate.any()
    assert result.matches > 0.9 * POINTS


@pytest.mark.parametrize("seed", range(3))
def test_a_narrow_kernel_opens_as_wide_as_the_prediction_may_be_wrong(seed):
    """From 1 m away a kernel of 3 cm sees outliers only, unless it includes the prediction's error."""
    params = params_with(lidar__range_sigma=0.03, registration__kernel=0.03)
    start, points = perturbed(1.0, 3.0, seed), scan_of("room", seed + 1)
    admitted, denied = (solve(MAPS["room"], points, start, error, params) for error in (2.0, 0.01))
    assert pose_error(admitted.T_world_lidar, TRUTH)[0] < 0.01
    assert pose_error(denied.T_world_lidar, TRUTH)[0] > 0.3


def test_the_kernel_is_closed_at_the_solution():
    """A prediction error below the kernel's own scale has no effect, though the scan has outliers."""
    points = scan_of("room", 4).at[::4].multiply(0.97)
    start = perturbed(0.1, 0.5, 2)
    closed, opened = (solve(MAPS["room"], points, start, error) for error in (0.0, 0.14))
    np.testing.assert_array_equal(opened.T_world_lidar.wxyz_xyz, closed.T_world_lidar.wxyz_xyz)


def test_a_noise_free_scan_is_placed_to_millimetres():
    result = solve(MAPS["room"], scan_of("room", 5, noise=0.0), perturbed(0.2, 1.0, 0), 0.3)
    moved, turned = pose_error(result.T_world_lidar, TRUTH)
    assert moved < 0.008
    assert turned < 0.1


@pytest.mark.parametrize("scene", SCENES)
def test_a_fifth_of_gross_outliers_does_not_matter(scene):
    points = np.array(scan_of(scene, 7))
    clean = solve(MAPS[scene], jnp.asarray(points), perturbed(0.1, 1.0, 1), 0.2)
    rng = np.random.default_rng(8)
    wrong = rng.random(POINTS) < 0.2
    # short returns, as of people and cars: all on one side, so that a plain mean would be pulled
    points[wrong] = points[wrong] * rng.uniform(0.3, 0.9, (wrong.sum(), 1)) + [0.5, 0.0, 0.0]
    result = solve(MAPS[scene], jnp.asarray(points), perturbed(0.1, 1.0, 1), 0.2)
    moved, turned = pose_error(result.T_world_lidar, TRUTH)
    assert result.status == CONVERGED
    assert moved < 0.03
    assert turned < 0.2
    assert pose_error(result.T_world_lidar, clean.T_world_lidar)[0] < 0.015


def test_ten_kilometres_away_is_as_good_as_at_the_origin():
    far = np.array([10000.4, -9999.3, 120.7])
    points = sample(ROOM, 40000, NOISE, seed=0)
    vmap = map_of(points + far, PARAMS, centre=far)
    truth = pose(far, [0, 0, 0]) @ TRUTH
    start = pose(far, [0, 0, 0]) @ perturbed(0.3, 2.0, 3)
    result = solve(vmap, scan_of("room", 2), start, 0.5)
    moved, turned = pose_error(result.T_world_lidar, truth)
    assert result.status == CONVERGED
    assert moved < 0.01
    assert turned < 0.2


def test_points_may_depend_on_the_pose_under_trial():
    """A scan compensated with the motion that the trial pose implies: a rule known in closed form."""
    measured = scan_of("room", 9)
    start = perturbed(0.3, 2.0, 2)

    @jax.jit
    def solve_with(stretch):
        def points_at(T):
            move = (start.inverse() @ T).translation()
            return measured + (stretch * move).astype(jnp.float32)

        mask = jnp.ones(POINTS, bool)
        return register(MAPS["room"], points_at, mask, start, jnp.float64(0.5), PARAMS, 60)

    result = solve_with(jnp.float64(0.1))
    shift = matrix(result.T_world_lidar)[:3, 3] - matrix(start)[:3, 3]
    moved = 0.1 * matrix(start)[:3, :3].T @ shift
    # the points were shifted by a tenth of the move, so the pose that fits lies that much the other way
    expected = TRUTH @ pose(-moved, [0, 0, 0])
    assert pose_error(result.T_world_lidar, expected)[0] < 0.012


def test_masked_points_are_ignored():
    points = np.array(scan_of("room", 3))
    mask = np.random.default_rng(0).random(POINTS) < 0.7
    spoiled = jnp.asarray(np.where(mask[:, None], points, np.float32(1.0)))
    result = solve(MAPS["room"], spoiled, perturbed(0.1, 1.0, 4), 0.2, mask=mask)
    assert pose_error(result.T_world_lidar, TRUTH)[0] < 0.01
    assert result.matches <= mask.sum()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))


def test_rmse_is_the_scatter_of_the_scan_about_the_map():
    for noise in (0.01, 0.05):
        result = solve(MAPS["room"], scan_of("room", 4, noise), TRUTH, 0.1)
        # more than the scan's noise: the map is noisy too, and a voxel's finite extent counts a little
        assert 0.7 * noise < result.rmse < noise + NOISE + 0.03


@pytest.mark.parametrize("scene", SCENES)
def test_information_is_calibrated_in_order_of_magnitude(scene):
    """The scatter of 48 noisy scans of one place against the inverse information."""
    params = params_with()
    results = [solve(MAPS[scene], scan_of(scene, 2000 + k), TRUTH, 0.05, params) for k in range(48)]
    assert all(result.status == CONVERGED for result in results)
    # jaxlie's tangent is translation first
    errors = np.array([(TRUTH.inverse() @ r.T_world_lidar).log() for r in results])[:, [3, 4, 5, 0, 1, 2]]
    errors = errors - errors.mean(0)
    predicted = np.linalg.inv(np.mean([r.information for r in results], 0))
    ratio = errors.var(0, ddof=1) / np.diag(predicted)
    assert (ratio < 5).all(), ratio
    assert (ratio > 1 / 5).all(), ratio
    # whitened as a whole, so that an exchange of axes or a wrong frame shows
    whole = np.mean([e @ r.information @ e for e, r in zip(errors, results, strict=True)]) / 6
    assert 1 / 5 < whole < 5


def test_information_is_of_the_right_perturbation_rotation_first():
    """In a hall without ends the weak axis of the sensor's own frame follows the sensor's yaw."""
    hall = box_room(200.0, 9.0, 4.5)
    vmap = map_of(sample(hall, 60000, 0.01, seed=0, reach=20.0), PARAMS)
    for yaw, weak in ((0.2, 3), (0.2 + np.pi / 2, 4)):
        T = pose([0, 0, 0], [0, 0, yaw])
        result = solve(vmap, seen_from(T, sample(hall, POINTS, 0.01, 1, reach=12.0)), T)
        information = np.asarray(result.information)
        assert np.argmin(np.diag(information)) == weak
        # rotations have lever arms of metres
        assert np.diag(information)[:3].min() > np.diag(information)[3:].max()
        np.testing.assert_allclose(information, information.T, rtol=1e-9)


def test_an_empty_map_keeps_the_prediction():
    start = perturbed(0.3, 2.0, 0)
    result = solve(empty_map(1024), scan_of("room", 1), start, 2.0)
    assert result.status == LOST
    assert result.matches == 0
    np.testing.assert_array_equal(result.T_world_lidar.wxyz_xyz, start.wxyz_xyz)
    np.testing.assert_array_equal(result.information, 0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))


@pytest.mark.parametrize(("count", "status"), [(0, LOST), (49, LOST), (80, CONVERGED)])
def test_too_few_matches_keep_the_prediction(count, status):
    start = perturbed(0.1, 1.0, 0)
    mask = np.arange(POINTS) < count
    result = solve(MAPS["room"], scan_of("room", 1), start, 0.2, mask=mask)
    assert result.status == status
    kept = np.array_equal(result.T_world_lidar.wxyz_xyz, start.wxyz_xyz)
    assert kept == (status == LOST)


def test_a_scan_of_another_place_keeps_the_prediction():
    start = pose([500.0, 0, 0], [0, 0, 0])
    result = solve(MAPS["room"], scan_of("room", 1), start, 2.0)
    assert result.status == LOST
    np.testing.assert_array_equal(result.T_world_lidar.wxyz_xyz, start.wxyz_xyz)


def test_a_bound_of_one_iteration_is_reported():
    result = solve(MAPS["room"], scan_of("room", 1), perturbed(0.5, 2.0, 0), 1.0, max_iterations=1)
    assert result.status == ITERATION_LIMIT
    assert result.iterations == 1


def test_iterations_stop_when_the_steps_are_small():
    result = solve(MAPS["room"], scan_of("room", 1), TRUTH, 0.05)
    assert result.status == CONVERGED
    assert 1 < result.iterations < 15


def test_repeats_bit_for_bit():
    first, second = (solve(MAPS["room"], scan_of("room", 1), perturbed(0.3, 2, 0), 0.5) for _ in range(2))
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(one, other)
