"""Lines and planes through nearest neighbours against numpy's linear algebra, a k-d tree and differences."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lio_jax.mapping.feature_map import FeaturePoints, Frames
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.point_map import EDGE, empty_map, insert
from lio_jax.mapping.voxel_map import anchor_of
from lio_jax.registration.knn_planes import planes_near
from lio_jax.registration.lines_and_planes import (
    FittedTo,
    LinesAndPlanes,
    fit_lines,
    huber,
    line_through,
    linearise,
    lines_near,
    no_lines_and_planes,
)
from lio_jax.settings.settings import recipe_settings, with_overrides
from tests.mapping.test_point_map import held
from tests.registration.test_knn_planes import columns

SETTINGS = recipe_settings("loam")
PARAMS = SETTINGS.params()
POSE = jaxlie.SE3.from_rotation_and_translation(
    jaxlie.SO3.from_rpy_radians(0.03, -0.02, 0.4), jnp.array([1.3, -0.7, 1.6])
)


@jax.jit
def _fit(x, y, z):
    centre, direction, variances = fit_lines(x, y, z)
    lines = line_through(centre, direction, jnp.ones(x.shape[1], bool), jnp.zeros(x.shape, jnp.int32))
    return lines, direction, variances


_lines = jax.jit(lines_near, static_argnums=6)
_planes = jax.jit(planes_near, static_argnums=6)


@jax.jit
def _linearise(matches, points, T, frames, kernel, range_sigma):
    corners, surfaces = matches.lines.first.entry, matches.planes.entry
    fitted_to = FittedTo(*(jnp.zeros((entry.shape[1], 3 * len(entry))) for entry in (corners, surfaces)))
    return linearise(matches, points, T, frames, huber(kernel), range_sigma, fitted_to)


def params_with(*assignments: str):
    return with_overrides(SETTINGS, assignments).params()


def frame_of(size) -> Frame:
    return Frame(*anchor_of(POSE.translation(), EDGE * jnp.asarray(size, jnp.float64)))


def five(count: int, noise: float, seed: int) -> np.ndarray:
    """Return (count, 5, 3) points near lines of any direction, up to 50 m from the origin."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 1, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    points = rng.uniform(-0.8, 0.8, (count, 5, 1)) * direction + rng.normal(0, noise, (count, 5, 3))
    return (points + rng.uniform(-50, 50, (count, 1, 3))).astype(np.float32).astype(float)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1, 0.6])
def test_lines_are_those_of_the_eigenvalue_decomposition(noise):
    points = five(400, noise, seed=0)
    lines, direction, variances = _fit(*columns(points))
    centre = points.mean(1)
    away = points - centre[:, None]
    values, vectors = np.linalg.eigh(np.einsum("kni,knj->kij", away, away) / 5)
    np.testing.assert_allclose(variances, values, atol=1e-5 + 1e-5 * values.max())
    clear = (values[:, 2] > 1.5 * values[:, 1]) & (values[:, 2] > 0.05)
    assert clear.mean() > 0.5
    sine = np.linalg.norm(np.cross(np.asarray(direction, float), vectors[..., 2]), axis=1)
    assert sine[clear].max() < 1e-3
    # the two planes' distances make up the distance from the line
    query = centre + np.random.default_rng(1).normal(0, 0.3, centre.shape)
    across = [
        np.einsum("ki,ki->k", np.asarray(plane.normal, float), query) + np.asarray(plane.offset, float)
        for plane in (lines.first, lines.second)
    ]
    expected = np.linalg.norm(np.cross(query - centre, vectors[..., 2]), axis=1)
    np.testing.assert_allclose(np.hypot(*across)[clear], expected[clear], atol=2e-3)


@pytest.mark.parametrize("points", [np.zeros((1, 5, 3)), np.full((1, 5, 3), 7.0)])
def test_points_without_a_line_give_finite_numbers(points):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(_fit(*columns(points))))


def poles_and_wall(seed: int) -> np.ndarray:
    """Return points of upright poles, of a wall and of bushes."""
    rng = np.random.default_rng(seed)
    feet = rng.uniform(-15, 15, (60, 2))
    poles = np.concatenate(
        [np.stack([np.full(12, x), np.full(12, y), rng.uniform(0, 4, 12)], -1) for x, y in feet]
    )
    wall = np.stack([rng.uniform(-15, 15, 600), np.full(600, 6.0), rng.uniform(0, 4, 600)], -1)
    bushes = rng.normal([3.0, 2.0, 1.0], 0.8, (300, 3))
    return (np.concatenate([poles, wall, bushes]) + rng.normal(0, 0.02, (1620, 3))).astype(np.float32)


def map_with(points: np.ndarray, size: float):
    origin = np.zeros(3, np.int32)
    pmap, _ = jax.jit(insert)(
        empty_map(16384),
        jnp.asarray(points),
        jnp.ones(len(points), bool),
        jnp.asarray(origin),
        jnp.float32(size),
        jnp.float32(300.0),
        jnp.float32(0.1),
    )
    return pmap


@pytest.fixture(scope="module")
def scene():
    pmap = map_with(poles_and_wall(0), 0.4)
    return pmap, held(pmap, 0.4)


def near_by_hand(points: np.ndarray, tree_points: np.ndarray):
    distance, index = cKDTree(tree_points).query(points, 5)
    near = tree_points[index]
    away = near - near.mean(1, keepdims=True)
    return distance, near, np.linalg.eigh(np.einsum("kni,knj->kij", away, away) / 5)


@pytest.mark.parametrize(("ratio", "radius"), [(3.0, 1.0), (8.0, 1.0), (3.0, 0.6)])
def test_line_matches_are_those_of_a_k_d_tree_and_a_decomposition(scene, ratio, radius):
    pmap, points = scene
    queries = poles_and_wall(0)[::2] + np.random.default_rng(5).normal(0, 0.05, (810, 3))
    knn = params_with(f"params.knn.line_ratio={ratio}", f"params.knn.radius={radius}").knn
    mask = np.arange(len(queries)) % 9 > 0
    lines = _lines(
        pmap, jnp.asarray(queries), jnp.asarray(mask), jnp.zeros(3, jnp.int32), jnp.float64(0.4), knn, 5
    )
    distance, near, (values, vectors) = near_by_hand(queries, points)
    valid = (distance[:, -1] < radius) & (values[:, 2] > ratio * values[:, 1]) & mask
    # where two points are as near as each other, or the ratio is at its limit, rounding decides
    sixth = cKDTree(points).query(queries, 6)[0][:, 5]
    certain = (sixth - distance[:, -1] > 2e-3) & (np.abs(distance[:, -1] - radius) > 1e-3)
    certain &= np.abs(values[:, 2] / values[:, 1] / ratio - 1) > 0.01
    assert certain.mean() > 0.7
    np.testing.assert_array_equal(np.asarray(lines.first.valid)[certain], valid[certain])
    assert 0.1 < valid.mean() < 0.9
    chosen = certain & valid
    across = [
        np.einsum("ki,ki->k", np.asarray(plane.normal, float), queries) + np.asarray(plane.offset, float)
        for plane in (lines.first, lines.second)
    ]
    expected = np.linalg.norm(np.cross(queries - near.mean(1), vectors[..., 2]), axis=1)
    np.testing.assert_allclose(np.hypot(*across)[chosen], expected[chosen], atol=2e-3)


def some_matches(seed: int = 0):
    """Return matches and points whose distances lie on both sides of the kernel."""
    rng = np.random.default_rng(seed)
    corners, surfaces = 60, 90

    def units(count: int) -> np.ndarray:
        vectors = rng.normal(size=(count, 3))
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    points = FeaturePoints(
        jnp.asarray(rng.uniform(-20, 20, (corners, 3))),
        jnp.asarray(rng.random(corners) > 0.2),
        jnp.asarray(rng.uniform(-20, 20, (surfaces, 3))),
        jnp.asarray(rng.random(surfaces) > 0.2),
    )
    frames = Frames(frame_of(0.4), frame_of(0.8))
    empty = no_lines_and_planes(points, 5, 5, jnp.float32)
    _, corner = frames.corner.place(points.corner, POSE)
    _, surface = frames.surface.place(points.surface, POSE)
    direction = units(corners)
    first = np.cross(direction, units(corners))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(direction, first)

    def through(normal: np.ndarray, near: jax.Array, valid: jax.Array):
        offset = -np.sum(normal * np.asarray(near), 1) + rng.normal(0, 0.1, len(normal))
        kind, entry = type(empty.planes), jnp.zeros((5, len(normal)), jnp.int32)
        return kind(jnp.asarray(normal, jnp.float32), jnp.asarray(offset, jnp.float32), valid, entry)

    lines = type(empty.lines)(
        through(first, corner, points.corner_mask), through(second, corner, points.corner_mask)
    )
    planes = through(units(surfaces), surface, points.surface_mask)
    return LinesAndPlanes(lines, planes), points, frames


def distances(matches, points, frames, delta: np.ndarray) -> np.ndarray:
    """Return each matched point's distance after a turn about the sensor and a move, in double precision."""
    turn = np.asarray(jaxlie.SO3.exp(jnp.asarray(delta[:3])).as_matrix())
    rotation = turn @ np.asarray(POSE.rotation().as_matrix())

    def from_planes(planes, rows, frame) -> np.ndarray:
        placed = np.asarray(rows) @ rotation.T + np.asarray(POSE.translation()) + delta[3:]
        return np.sum(np.asarray(planes.normal, float) * (placed - np.asarray(frame.origin)), 1) + np.asarray(
            planes.offset, float
        )

    lines = matches.lines
    squared = from_planes(lines.first, points.corner, frames.corner) ** 2
    squared += from_planes(lines.second, points.corner, frames.corner) ** 2
    surface = from_planes(matches.planes, points.surface, frames.surface)
    return np.concatenate(
        [
            np.sqrt(squared)[np.asarray(lines.first.valid)],
            np.abs(surface)[np.asarray(matches.planes.valid)],
        ]
    )


def huber_loss(distance: np.ndarray, kernel: float) -> float:
    return float(np.sum(np.where(distance < kernel, distance**2 / 2, kernel * (distance - kernel / 2))))


def test_the_gradient_is_that_of_hubers_loss():
    """Compared with central differences, in double precision."""
    matches, points, frames = some_matches()
    kernel, sigma = 0.1, 0.05
    equations = _linearise(matches, points, POSE, frames, jnp.float64(kernel), jnp.float64(sigma))
    step = 1e-6
    expected = [
        (
            huber_loss(distances(matches, points, frames, step * e), kernel)
            - huber_loss(distances(matches, points, frames, -step * e), kernel)
        )
        / (2 * step)
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(equations.gradient, np.array(expected) / sigma**2, rtol=1e-5, atol=1e-3)
    away = distances(matches, points, frames, np.zeros(6))
    assert 0.2 < (away < kernel).mean() < 0.8
    assert int(equations.matches) == len(away)
    weight = np.minimum(1, kernel / away)
    np.testing.assert_allclose(equations.weight, weight.sum(), rtol=1e-6)
    np.testing.assert_allclose(equations.squared_error, np.sum(weight * away**2), rtol=1e-6)


def test_the_hessian_is_that_of_the_weighted_distances():
    """With a kernel of weight 1: J'J of the distances from planes and from a line's two planes."""
    matches, points, frames = some_matches(1)
    equations = _linearise(matches, points, POSE, frames, jnp.float64(1e3), jnp.float64(1.0))
    rotation = np.asarray(POSE.rotation().as_matrix())
    hessian = np.zeros((6, 6))
    for planes, rows in (
        (matches.lines.first, points.corner),
        (matches.lines.second, points.corner),
        (matches.planes, points.surface),
    ):
        normal = np.asarray(planes.normal, float)
        J = np.concatenate([np.cross(np.asarray(rows) @ rotation.T, normal), normal], 1)
        J = J[np.asarray(planes.valid)]
        hessian += J.T @ J
    np.testing.assert_allclose(equations.hessian, hessian, rtol=1e-6, atol=1e-6 * hessian.max())


@pytest.mark.parametrize("filler", [np.nan, np.inf, 1e30])
def test_what_stands_in_masked_rows_does_not_matter(filler):
    matches, points, frames = some_matches()
    spoiled = FeaturePoints(
        jnp.where(points.corner_mask[:, None], points.corner, filler),
        points.corner_mask,
        jnp.where(points.surface_mask[:, None], points.surface, filler),
        points.surface_mask,
    )
    plain, other = (
        _linearise(matches, rows, POSE, frames, jnp.float64(0.1), jnp.float64(0.05))
        for rows in (points, spoiled)
    )
    for one, again in zip(jax.tree.leaves(plain), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(one, again)


def test_nothing_matched_gives_finite_zeros():
    _, points, frames = some_matches()
    nothing = no_lines_and_planes(points, 5, 5, jnp.float32)
    equations = _linearise(nothing, points, POSE, frames, jnp.float64(0.1), jnp.float64(0.05))
    assert equations.matches == 0
    assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(equations))


def test_five_neighbours_of_real_scans_are_those_of_a_k_d_tree():
    """Planes of the loam recipe's map, from real scans: recall within its search radius."""
    from pathlib import Path

    from lio_jax.data.config import DataConfig
    from lio_jax.data.detect import open_sequence
    from lio_jax.mapping.nearest_points import nearest_points

    folder = Path(__file__).resolve().parents[2].parent / "shared/data/kitti_odometry/sequences/04"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    first, second = (scan.points for scan in open_sequence(folder, DataConfig()).scans(0, 2))
    for size, every in ((0.4, 12), (0.8, 4)):
        pmap = map_with(first[::every], size)
        points, queries = held(pmap, size), second[5::60]
        found = jax.jit(nearest_points, static_argnums=5)(
            pmap,
            jnp.asarray(queries),
            jnp.ones(len(queries), bool),
            jnp.zeros(3, jnp.int32),
            jnp.float32(size),
            5,
            jnp.float32(1.0),
        )
        expected = cKDTree(points).query(queries, 5)[0]
        distance = np.sqrt(np.asarray(found.squared_distance, float)).T
        within = expected < 1.0
        assert within.sum() > 1000
        recalled = np.abs(distance - expected) < 2e-3 * expected + 1e-5
        assert recalled[within].mean() >= 0.999
