"""Planes through nearest neighbours against numpy's linear algebra and a brute-force association."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lio_jax.mapping.frame import Frame
from lio_jax.mapping.point_map import EDGE, empty_map, insert
from lio_jax.mapping.voxel_map import anchor_of
from lio_jax.registration.knn_planes import associate, fit_planes, linearise, no_planes
from lio_jax.registration.scan_match import associated, no_association
from lio_jax.settings.settings import recipe_settings, with_overrides
from tests.mapping.test_nearest_points import street
from tests.mapping.test_point_map import held, put

SETTINGS = recipe_settings("fast_lio2")
PARAMS = SETTINGS.params()
POSE = jaxlie.SE3.from_rotation_and_translation(
    jaxlie.SO3.from_rpy_radians(0.03, -0.02, 0.4), jnp.array([1.3, -0.7, 1.6])
)
FRAME = Frame(*anchor_of(POSE.translation(), EDGE * PARAMS.map.voxel_size))


@partial(jax.jit, static_argnums=6)
def _associate(pmap, points, mask, T, frame, params, neighbours):
    width = params.knn.least_width * params.map.voxel_size
    return associate(pmap, points, mask, T, frame, params.map, params.knn, neighbours, width)


@jax.jit
def _associated(last, pmap, points, mask, T, params):
    return associated(
        last,
        lambda: associate(pmap, points, mask, T, FRAME, params.map, params.knn, 5),
        points,
        mask,
        T,
        params.registration.reassociation_distance,
    )


@jax.jit
def _linearise(planes, points, T, frame, params):
    fitted_to = jnp.zeros((len(points), 3 * len(planes.entry)))
    return linearise(planes, points, T, frame, params.knn, params.lidar, fitted_to)


_fit = jax.jit(fit_planes)


def params_with(*assignments: str):
    return with_overrides(SETTINGS, assignments).params()


def five(count: int, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (count, 5, 3) points near planes of any direction, 50 m from the origin, and the normals."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    points = rng.uniform(-0.7, 0.7, (count, 5, 3))
    points -= np.einsum("kni,ki->kn", points, normal)[..., None] * normal[:, None]
    points += rng.normal(0, noise, (count, 5, 1)) * normal[:, None]
    return points + rng.uniform(-50, 50, (count, 1, 3)), normal


def columns(points: np.ndarray) -> list[jax.Array]:
    return [jnp.asarray(points[..., axis].T, jnp.float32) for axis in range(3)]


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.03])
def test_planes_are_those_of_the_singular_value_decomposition(noise):
    points, _ = five(400, noise, seed=0)
    points = points.astype(np.float32).astype(float)
    fitted, offset, farthest, _ = _fit(*columns(points))
    mean = points.mean(1)
    values, vectors = np.linalg.svd(points - mean[:, None])[1:]
    expected = vectors[:, 2]
    clear = values[:, 1] > 0.3
    assert clear.mean() > 0.6
    normal = np.asarray(fitted, float)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    sine = np.linalg.norm(np.cross(normal, expected), axis=1)
    assert sine[clear].max() < 2e-3
    distance = np.einsum("kni,ki->kn", points, normal) + np.asarray(offset)[:, None]
    np.testing.assert_allclose(distance[clear].mean(1), 0, atol=2e-5)
    np.testing.assert_allclose(
        np.asarray(farthest)[clear],
        np.abs(np.einsum("kni,ki->kn", points - mean[:, None], expected)).max(1)[clear],
        atol=1e-3,
    )


def test_a_plane_through_the_origin_is_a_plane_like_any_other():
    """The equation m'p = -1 has no solution there."""
    points, normal = five(100, 0.0, seed=1)
    points -= points.mean(1, keepdims=True)
    fitted, _, farthest, _ = _fit(*columns(points))
    along = np.abs(np.einsum("ki,ki->k", np.asarray(fitted), normal))
    assert np.quantile(along, 0.05) > 0.9999
    assert np.asarray(farthest).max() < 1e-4


@pytest.mark.parametrize(
    "points", [np.zeros((1, 5, 3)), np.full((1, 5, 3), 7.0), np.outer(np.arange(5.0), [1, 2, 3])[None]]
)
def test_points_without_a_plane_give_finite_numbers(points):
    assert all(np.isfinite(leaf).all() for leaf in _fit(*columns(points)))


@pytest.fixture(scope="module")
def scene():
    pmap, _, dropped = put(empty_map(16384), street(0))
    assert dropped == 0
    return pmap, held(pmap)


@pytest.fixture(scope="module")
def scan() -> tuple[jax.Array, jax.Array]:
    """Points of the same street in the lidar frame."""
    world = street(1)[::3] + np.random.default_rng(3).normal(0, 0.02, (667, 3))
    points = np.asarray(POSE.inverse().as_matrix() @ np.concatenate([world, np.ones((667, 1))], 1).T).T[:, :3]
    return jnp.asarray(points, jnp.float32), jnp.asarray(np.arange(667) % 10 > 0)


def matches_by_hand(points, held_points, radius, tolerance, least_width):
    """Return normal, centre and validity for each world point, one by one in double precision."""
    tree = cKDTree(held_points)
    normals, centres, valid, margins = [], [], [], []
    for point in points:
        distance, index = tree.query(point, 5)
        near = held_points[index]
        centre = near.mean(0)
        _, sizes, axes = np.linalg.svd(near - centre)
        normal, width = axes[2], sizes[1] / np.sqrt(5)
        worst = np.abs((near - centre) @ normal).max()
        normals.append(normal)
        centres.append(centre)
        valid.append(distance[-1] < radius and worst <= tolerance and width >= least_width)
        margins.append(min(abs(worst - tolerance), 1.5 - distance[-1], abs(width - least_width)))
    return np.array(normals), np.array(centres), np.array(valid), np.array(margins)


def world_of(points) -> np.ndarray:
    pose = np.asarray(POSE.as_matrix())
    return np.asarray(points, float) @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize(("tolerance", "width"), [(0.02, 0.4), (0.1, 0.0), (0.1, 0.6)])
def test_matches_are_those_of_a_k_d_tree_and_a_decomposition(scene, scan, tolerance, width):
    pmap, held_points = scene
    points, mask = scan
    params = params_with(f"params.knn.plane_tolerance={tolerance}", f"params.knn.least_width={width}")
    planes = _associate(pmap, points, mask, POSE, FRAME, params, 5)
    world, least_width = world_of(points), width * float(params.map.voxel_size)
    normals, centres, valid, margin = matches_by_hand(world, held_points, 5**0.5, tolerance, least_width)
    # within a block's edge the search is complete, and at the tolerance rounding decides
    certain = margin > 1e-3
    assert certain.mean() > 0.7
    np.testing.assert_array_equal(np.asarray(planes.valid)[certain], (valid & np.asarray(mask))[certain])
    assert 0.1 < valid.mean() < 0.98
    chosen = np.asarray(planes.valid) & certain
    distance = np.einsum("ki,ki->k", np.asarray(planes.normal, float), world - np.asarray(FRAME.origin))
    distance += np.asarray(planes.offset)
    expected = np.einsum("ki,ki->k", normals, world - centres)
    off = np.abs(np.abs(distance) - np.abs(expected))[chosen]
    assert np.quantile(off, 0.98) < 1e-3


def test_the_ring_of_a_sensor_on_the_ground_defines_no_plane():
    rng = np.random.default_rng(5)
    angles = np.arange(0, 2 * np.pi, 0.06)
    ring = 10 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1) + rng.normal(
        0, 0.02, (len(angles), 3)
    )
    origin = jnp.zeros(3, jnp.int32)
    half, size = jnp.float32(100), PARAMS.map.voxel_size.astype(jnp.float32)
    every = jnp.ones(len(ring), bool)
    placed = jnp.asarray(ring, jnp.float32)
    pmap, _ = jax.jit(insert)(empty_map(4096), placed, every, origin, size, half, jnp.float32(0))
    frame = Frame(origin, jnp.zeros(3))
    at_origin = jaxlie.SE3.identity()
    found = [
        np.asarray(_associate(pmap, placed, every, at_origin, frame, params_with(width), 5).valid).mean()
        for width in ("params.knn.least_width=0", "params.knn.least_width=0.4")
    ]
    assert found[0] > 0.8
    assert found[1] < 0.02


def test_neighbours_beyond_the_radius_make_no_match(scene, scan):
    pmap, held_points = scene
    points, mask = scan
    planes = _associate(pmap, points, mask, POSE, FRAME, params_with("params.knn.radius=0.9"), 5)
    farthest = cKDTree(held_points).query(world_of(points), 5)[0][:, -1]
    assert 0.05 < np.asarray(planes.valid).mean() < 0.9
    assert (farthest[np.asarray(planes.valid)] < 0.9).all()


def test_normal_equations_are_those_of_the_residuals(scene, scan):
    """Against derivatives of the distances by central differences, in double precision."""
    pmap, _ = scene
    points, mask = scan
    planes = _associate(pmap, points, mask, POSE, FRAME, PARAMS, 5)
    equations = _linearise(planes, points, POSE, FRAME, PARAMS)
    normal, offset = np.asarray(planes.normal, float), np.asarray(planes.offset, float)
    exact = np.asarray(points, float)

    def distances(delta: np.ndarray) -> np.ndarray:
        turn = np.asarray(jaxlie.SO3.exp(jnp.asarray(delta[:3])).as_matrix())
        rotation = turn @ np.asarray(POSE.rotation().as_matrix())
        placed = exact @ rotation.T + np.asarray(POSE.translation()) + delta[3:] - np.asarray(FRAME.origin)
        return np.einsum("ki,ki->k", normal, placed) + offset

    step = 1e-6
    H = np.stack([(distances(step * e) - distances(-step * e)) / (2 * step) for e in np.eye(6)], 1)
    d = distances(np.zeros(6))
    score = 1 - 0.9 * np.abs(d) / np.sqrt(np.linalg.norm(exact, axis=1))
    used = np.asarray(planes.valid) & (score > 0.9)
    assert 0 < (np.asarray(planes.valid) & ~used).sum() < 0.5 * used.sum()
    assert int(equations.matches) == used.sum()
    H, d = H[used], d[used]
    scale = np.abs(H.T @ H).max() / 0.001
    np.testing.assert_allclose(equations.hessian, H.T @ H / 0.001, atol=1e-5 * scale)
    np.testing.assert_allclose(equations.gradient, H.T @ d / 0.001, atol=2e-3 * np.abs(H.T @ d).max() / 0.001)
    np.testing.assert_allclose(equations.squared_error, np.sum(d**2), rtol=1e-3)
    np.testing.assert_allclose(equations.arm_squared, np.mean(np.sum(exact[used] ** 2, 1)), rtol=1e-5)


def test_planes_are_kept_until_the_scan_has_moved_away(scene, scan):
    pmap, _ = scene
    points, mask = scan
    first = _associated(no_association(no_planes(mask, 5), POSE), pmap, points, mask, POSE, PARAMS)
    limit = float(PARAMS.registration.reassociation_distance)

    def moved(metres: float) -> jaxlie.SE3:
        return jaxlie.SE3.from_rotation_and_translation(
            POSE.rotation(), POSE.translation() + jnp.array([metres, 0.0, 0.0])
        )

    near = _associated(first, pmap, points, mask, moved(0.9 * limit), PARAMS)
    far = _associated(first, pmap, points, mask, moved(30 * limit), PARAMS)
    np.testing.assert_array_equal(near.found.offset, first.found.offset)
    assert not np.array_equal(far.found.offset, first.found.offset)
    assert int(np.asarray(first.found.valid).sum()) > 100


@pytest.mark.parametrize("filler", [np.nan, np.inf, 1e30])
def test_what_stands_in_masked_rows_does_not_matter(scene, scan, filler):
    pmap, _ = scene
    points, mask = scan
    spoiled = jnp.where(mask[:, None], points, filler)
    one, other = (_associate(pmap, rows, mask, POSE, FRAME, PARAMS, 5) for rows in (points, spoiled))
    np.testing.assert_array_equal(one.offset, other.offset)
    for plain, again in zip(
        jax.tree.leaves(_linearise(one, points, POSE, FRAME, PARAMS)),
        jax.tree.leaves(_linearise(other, spoiled, POSE, FRAME, PARAMS)),
        strict=True,
    ):
        np.testing.assert_array_equal(plain, again)


def test_a_map_without_points_matches_nothing(scan):
    points, mask = scan
    planes = _associate(empty_map(16384), points, mask, POSE, FRAME, PARAMS, 5)
    equations = _linearise(planes, points, POSE, FRAME, PARAMS)
    assert equations.matches == 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((planes, equations)))
