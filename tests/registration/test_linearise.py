"""The normal equations against finite differences of the documented cost, written in numpy.

The map holds a few voxels far apart, so that the association is the same at every pose tried.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.mapping.frame import Frame
from lio_jax.mapping.voxel_map import anchor_of, empty_map, insert
from lio_jax.registration.scan_match import NormalEquations, relative_blur
from lio_jax.registration.voxel_planes import associate, least_variance, linearise, no_matches, point_noise
from tests.registration.scenes import map_of, matrix, params_with, pose

VOXEL, SIGMA = 1.2, 0.05
PARAMS = params_with(map__voxel_size=VOXEL, lidar__range_sigma=SIGMA)
TRUTH = pose([0.7, -0.4, 0.9], [0.1, -0.2, 0.3])


@jax.jit
def _linearise(vmap, points, mask, T, kernel, params) -> NormalEquations:
    frame = Frame(*anchor_of(T.translation(), params.map.voxel_size))
    matches = associate(vmap, points, mask, T, frame, params.map)
    return linearise(matches, points, T, frame, kernel, params.lidar)


def patches() -> list[np.ndarray]:
    """Return points of a wall, a floor, a pole, an edge and others, each within a voxel of its own."""
    rng = np.random.default_rng(0)
    low, high = 0.1, VOXEL - 0.1
    u, v, w = rng.uniform(low, high, (3, 50))
    noise = rng.normal(0, 0.004, (3, 50))
    shapes = [
        np.stack([0.5 + noise[0], u, v], -1),
        np.stack([u, v, 0.62 + 0.2 * u + noise[0]], -1),
        np.stack([0.4 + noise[0], 0.7 + noise[1], u], -1),
        np.stack([u, 0.3 + noise[0], 0.8 + noise[1]], -1),
        np.stack([u, v, w], -1),
        np.stack([u, 0.4 + 0.3 * v, 0.6 + noise[1]], -1),
    ]
    corners = VOXEL * np.array([[5, 0, 0], [0, -4, -2], [-6, 3, 1], [2, 7, 0], [-3, -6, 3], [4, 4, -4]])
    return [shape + corner for shape, corner in zip(shapes, corners, strict=True)]


PATCHES = patches()
MAP = map_of(np.concatenate(PATCHES), PARAMS, capacity=1024)


def held_points() -> list[np.ndarray]:
    """Return the points the map took: of each cell the one it says it added."""
    world = jnp.asarray(np.concatenate(PATCHES), jnp.float32)
    size, reach = jnp.float32(VOXEL), jnp.float32(100.0)
    mask, anchor = jnp.ones(len(world), bool), jnp.zeros(3, jnp.int32)
    vmap, first = insert(empty_map(1024), world, mask, anchor, size, reach)
    _, second = insert(vmap, world, mask, anchor, size, reach)
    added = np.asarray(first.added | second.added).reshape(len(PATCHES), -1)
    return [patch[taken] for patch, taken in zip(PATCHES, added, strict=True)]


def weight_matrices() -> tuple[np.ndarray, np.ndarray]:
    """Return each patch's mean and W = k n n' with k = 1 / (s^2 + l0) - 1 / (s^2 + l1)."""
    means, weights = [], []
    for points in held_points():
        variances, axes = np.linalg.eigh(np.cov(points.T, bias=True))
        precision = 1 / (SIGMA**2 + variances[0]) - 1 / (SIGMA**2 + variances[1])
        means.append(points.mean(0))
        weights.append(precision * np.outer(axes[:, 0], axes[:, 0]))
    return np.array(means), np.array(weights)


MEANS, WEIGHTS = weight_matrices()


def scan(count: int, spread: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return points in the lidar frame near the patches, and which patch each is near."""
    rng = np.random.default_rng(seed)
    patch = rng.integers(0, len(PATCHES), count)
    world = MEANS[patch] + rng.uniform(-spread, spread, (count, 3))
    T = np.linalg.inv(matrix(TRUTH))
    return (world @ T[:3, :3].T + T[:3, 3]).astype(np.float32), patch


def moved(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the pose turned and moved in world axes at the sensor's position."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ T[:3, :3]
    result[:3, 3] = T[:3, 3] + step[3:]
    return result


def errors(points, patch, T) -> np.ndarray:
    return points.astype(float) @ T[:3, :3].T + T[:3, 3] - MEANS[patch]


def squared_distances(points, patch, T) -> np.ndarray:
    """Return the noise-scaled squared distance of each point, m^2."""
    error = errors(points, patch, T)
    return SIGMA**2 * np.einsum("ni,nij,nj->n", error, WEIGHTS[patch], error)


def cost(points, patch, T, kernel) -> float:
    """Return the Geman-McClure cost, half the squared whitened distance where it is small."""
    squared = squared_distances(points, patch, T)
    robust = squared if np.isinf(kernel) else kernel**2 * squared / (kernel**2 + squared)
    return float(0.5 * robust.sum() / SIGMA**2)


def differences(function, step=1e-5) -> np.ndarray:
    """Return central differences of ``function(pose)`` along the six directions, last axis."""
    T = matrix(TRUTH)
    slopes = [
        (function(moved(T, step * direction)) - function(moved(T, -step * direction))) / (2 * step)
        for direction in np.eye(6)
    ]
    return np.stack(slopes, -1)


def equations(points, mask=None, kernel=1e4, T: jaxlie.SE3 = TRUTH) -> NormalEquations:
    mask = np.ones(len(points), bool) if mask is None else mask
    return _linearise(MAP, jnp.asarray(points), jnp.asarray(mask), T, jnp.float64(kernel), PARAMS)


def assert_close(found, expected, relative=2e-4) -> None:
    """Compare to a fraction of the largest entry: the sums are formed in float32."""
    found, expected = np.asarray(found), np.asarray(expected)
    np.testing.assert_allclose(found, expected, atol=relative * np.abs(expected).max())


def test_gradient_is_that_of_the_quadratic_cost():
    points, patch = scan(400, 0.15)
    slope = differences(lambda T: cost(points, patch, T, np.inf))
    assert_close(equations(points).gradient, slope)


@pytest.mark.parametrize("kernel", [0.03, 0.2, 1.0])
def test_gradient_is_that_of_the_robust_cost(kernel):
    points, patch = scan(400, 0.3)
    slope = differences(lambda T: cost(points, patch, T, kernel))
    assert_close(equations(points, kernel=kernel).gradient, slope, relative=1e-3)


def test_gradient_by_automatic_differentiation_of_the_cost():
    points, patch = scan(400, 0.15)

    def total(step):
        rotation = jaxlie.SO3.exp(step[:3]) @ TRUTH.rotation()
        arms = jax.vmap(rotation.apply)(jnp.asarray(points, jnp.float64))
        error = arms + TRUTH.translation() + step[3:] - MEANS[patch]
        return 0.5 * jnp.einsum("ni,nij,nj->", error, jnp.asarray(WEIGHTS[patch]), error)

    assert_close(equations(points).gradient, jax.grad(total)(jnp.zeros(6)))


def test_hessian_is_that_of_the_quadratic_cost_where_the_scan_lies_on_the_map():
    """At the minimum Gauss-Newton's matrix is the whole second derivative."""
    points, patch = scan(400, 0.0)
    curvature = differences(lambda T: differences_at(points, patch, T))
    assert_close(equations(points).hessian, curvature, 1e-3)


def differences_at(points, patch, T, step=1e-4) -> np.ndarray:
    return np.array(
        [
            (
                cost(points, patch, moved(T, step * direction), np.inf)
                - cost(points, patch, moved(T, -step * direction), np.inf)
            )
            / (2 * step)
            for direction in np.eye(6)
        ]
    )


@pytest.mark.parametrize("kernel", [0.2, np.inf])
def test_hessian_is_the_weighted_product_of_jacobians(kernel):
    points, patch = scan(400, 0.3)
    jacobian = differences(lambda T: errors(points, patch, T))
    squared = squared_distances(points, patch, matrix(TRUTH))
    robust = np.ones(400) if np.isinf(kernel) else (kernel**2 / (kernel**2 + squared)) ** 2
    expected = np.einsum("n,nmi,nmk,nkj->ij", robust, jacobian, WEIGHTS[patch], jacobian)
    found = np.asarray(equations(points, kernel=min(kernel, 1e4)).hessian)
    assert_close(found, expected)
    np.testing.assert_array_equal(found, found.T)
    assert np.linalg.eigvalsh(found)[0] > -1e-6 * np.linalg.eigvalsh(found)[-1]


@pytest.mark.parametrize("kernel", [0.05, 0.2])
def test_sums_are_those_of_the_matched_points(kernel):
    points, patch = scan(400, 0.3)
    squared = squared_distances(points, patch, matrix(TRUTH))
    robust = (kernel**2 / (kernel**2 + squared)) ** 2
    found = equations(points, kernel=kernel)
    assert found.matches == 400
    np.testing.assert_allclose(found.weight, robust.sum(), rtol=1e-4)
    np.testing.assert_allclose(found.squared_error, (robust * squared).sum(), rtol=1e-3)
    np.testing.assert_allclose(found.arm_squared, (points.astype(float) ** 2).sum(1).mean(), rtol=1e-5)


@pytest.mark.parametrize("width", [0.0, SIGMA, 0.3])
def test_a_voxel_acts_as_narrower_by_the_least_width_and_a_narrow_one_is_no_plane(width):
    points, patch = scan(400, 0.3)
    frame = Frame(*anchor_of(TRUTH.translation(), PARAMS.map.voxel_size))
    mask = jnp.ones(len(points), bool)
    matches = associate(MAP, jnp.asarray(points), mask, TRUTH, frame, PARAMS.map)
    matches = replace(matches, least_variance=jnp.float32(width**2))
    found = point_noise(matches, jnp.asarray(points), TRUTH, frame, PARAMS.lidar).precision
    expected = []
    for held in held_points():
        flat, wide, _ = np.linalg.eigvalsh(np.cov(held.T, bias=True))
        wide = max(flat, wide - width**2)
        expected.append(1 / (SIGMA**2 + flat) - 1 / (SIGMA**2 + wide))
    np.testing.assert_allclose(found, np.array(expected)[patch], rtol=1e-3, atol=0.05)
    lines = [number for number, value in enumerate(expected) if value < 1e-9]
    assert bool(lines) == (width > 0)
    assert len(lines) < len(expected)


def given_variances(wide):
    """Return matches in voxels with these second largest standard deviations, m; the last one is not used."""
    wide = jnp.asarray(wide, jnp.float32)
    found = no_matches(jnp.ones(len(wide), bool), jnp.float32)
    used = jnp.arange(len(wide)) < len(wide) - 1
    return replace(found, variances=jnp.stack([jnp.zeros_like(wide), wide**2], -1), used=used)


@pytest.mark.parametrize(
    ("wide", "expected"),
    [
        # a third of the used ones is as wide
        ([0.3, 0.1, 0.1, 0.3], 0.2),
        ([0.19, 0.05, 0.11, 0.3], 0.1),
        ([0.04, 0.03, 0.02, 0.3], 0.025),
        ([0.02, 0.01, 0.01, 0.3], 0.0),
        # nothing is matched
        ([0.3], 0.2),
    ],
)
def test_the_least_width_is_halved_until_a_third_of_the_matches_is_wide(wide, expected):
    found = least_variance(given_variances(wide), jnp.float32(0.2**2))
    np.testing.assert_allclose(np.sqrt(found), expected, rtol=1e-6)


def blur(points, patch, T) -> float:
    """Return the mean loss with a kernel of half the noise, over the geometric mean of the squared ranges."""
    squared, wide = squared_distances(points, patch, T), (SIGMA / 2) ** 2
    ranges = np.linalg.norm(points.astype(float), axis=1)
    return float(np.mean(wide * squared / (wide + squared)) / np.exp(2 * np.mean(np.log(ranges))))


def test_blur_is_the_narrow_loss_relative_to_the_ranges_and_so_is_its_derivative():
    points, patch = scan(400, 0.1)
    np.testing.assert_allclose(equations(points).blur, blur(points, patch, matrix(TRUTH)), rtol=1e-4)

    def lengthened(metres):
        distances = np.linalg.norm(points.astype(float), axis=1)[:, None]
        return points * (1 + metres / distances)

    ranges = jnp.linalg.norm(points, axis=1, keepdims=True)
    outward = (jnp.asarray(points / ranges),)
    _, slope = jax.jvp(lambda points: equations(points).blur, (jnp.asarray(points),), outward)
    ends = [blur(lengthened(step), patch, matrix(TRUTH)) for step in (-1e-5, 1e-5)]
    np.testing.assert_allclose(slope, (ends[1] - ends[0]) / 2e-5, rtol=1e-2)


def test_blur_does_not_depend_on_the_size_of_the_world():
    error, weight, arm = jnp.asarray(0.3), jnp.asarray(40.0), jnp.asarray(90.0)
    small, large = relative_blur(error, weight, arm), relative_blur(4 * error, weight, 4 * arm)
    assert small > 0
    assert large == pytest.approx(float(small))
    assert relative_blur(error, 0 * weight, arm) == 0


def test_the_shape_of_a_voxel_decides_what_it_measures():
    """A wall measures along its normal; a pole or a scan line, whose normal is open, next to nothing."""
    scale = SIGMA**2
    wall, floor, pole, edge, cloud = (np.linalg.eigvalsh(scale * w) for w in WEIGHTS[:5])
    for flat in (wall, floor):
        assert flat[2] > 0.9
        assert abs(flat[1]) < 1e-6
    for shape in (pole, edge, cloud):
        assert shape[2] < 0.05
    for patch, (directions, weights) in enumerate(zip(np.eye(6)[None].repeat(5, 0), WEIGHTS, strict=False)):
        T = matrix(TRUTH)
        point = (np.linalg.inv(T) @ np.append(MEANS[patch], 1))[:3].astype(np.float32)
        found = np.asarray(equations(np.repeat(point[None], 8, 0)).hessian)[3:, 3:] / 8
        np.testing.assert_allclose(directions[3:, 3:] @ found, weights, atol=2e-4 / scale)


@pytest.mark.parametrize("filler", [0.0, 1.0, -1e4])
def test_masked_points_do_not_count(filler):
    points, _ = scan(400, 0.2)
    mask = np.arange(400) % 4 > 0
    spoiled = np.where(mask[:, None], points, np.float32(filler))
    some, alone = equations(spoiled, mask), equations(points[mask])
    for one, other in zip(jax.tree.leaves(some), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-2)
    assert some.matches == 300


def test_points_without_a_voxel_do_not_count():
    points, _ = scan(200, 0.2)
    away = points + np.float32(50.0)
    alone, both = equations(points), equations(np.concatenate([points, away]))
    assert both.matches == alone.matches == 200
    assert_close(both.hessian, alone.hessian)
    assert_close(both.gradient, alone.gradient)


def test_nothing_matched_gives_zeros():
    points, _ = scan(50, 0.2)
    for leaf in jax.tree.leaves(equations(points + np.float32(100))):
        np.testing.assert_array_equal(leaf, 0)


def test_sums_have_the_precision_of_the_state():
    found = equations(scan(50, 0.2)[0])
    assert found.hessian.dtype == found.gradient.dtype == jnp.float64
