"""What the noise of normals seems to tell, against samples of noisy planes and in scenes without a hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.mapping.frame import Frame
from lio_jax.mapping.voxel_map import anchor_of
from lio_jax.registration.point_evidence import information_by_tilts, shown_by_noise, tilt_covariance
from lio_jax.registration.voxel_planes import associate, linearise
from tests.registration.scenes import (
    ROOM,
    box_room,
    map_of,
    params_with,
    pose,
    rectangle,
    sample,
    seen_from,
)

NOISE = 0.03
PARAMS = params_with(map__voxel_size=0.8, lidar__range_sigma=NOISE)


def whole(tilts, normal):
    """Return the covariances of the normals' errors, (k, 3, 3)."""
    axial, diagonal, off_diagonal = (np.asarray(part, float) for part in tilts)
    (xx, yy, zz), (xy, xz, yz) = diagonal.T, off_diagonal.T
    rest = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(-1, 3, 3)
    return axial[:, None, None] * normal[:, :, None] * normal[:, None, :] + rest


@pytest.mark.parametrize("count", [12, 40])
def test_normals_vary_as_stated(count):
    rng = np.random.default_rng(count)
    turn = Rotation.from_rotvec([0.4, -0.7, 0.3]).as_matrix()
    flat = rng.uniform(-1, 1, (4000, count, 3)) * [0.4, 0.2, 0.0] + rng.normal(0, 0.01, (4000, count, 3))
    points = flat @ turn.T
    centred = points - points.mean(1, keepdims=True)
    covariance = np.einsum("kni,knj->kij", centred, centred) / count
    values, vectors = np.linalg.eigh(covariance)
    normal = vectors[:, :, 0] * np.sign(vectors[:, :, 0] @ turn[:, 2])[:, None]
    off = normal - turn[:, 2]
    tilts = tilt_covariance(
        jnp.asarray(values[:, :2]),
        jnp.full(len(values), float(count)),
        jnp.asarray(covariance[:, [0, 1, 2], [0, 1, 2]]),
        jnp.asarray(covariance[:, [0, 0, 1], [1, 2, 2]]),
        jnp.array(0.0),
    )
    stated = turn.T @ whole(tilts, normal).mean(0) @ turn
    found = turn.T @ (off.T @ off / len(off)) @ turn
    np.testing.assert_allclose(np.diag(stated)[:2], np.diag(found)[:2], rtol=0.15)
    np.testing.assert_allclose(stated, found, atol=0.1 * found[1, 1])


def test_the_information_is_the_sum_over_the_points():
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(30, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    weight, root = rng.uniform(1, 2, 30), rng.normal(size=(30, 3, 3))
    rest, axial = root @ root.transpose(0, 2, 1), rng.normal(size=30)
    parts = axial, rest[:, [0, 1, 2], [0, 1, 2]], rest[:, [0, 0, 1], [1, 2, 2]]
    expected = np.einsum("k,kij->ij", weight, whole(parts, normal))
    given = tuple(jnp.asarray(part) for part in parts)
    found = information_by_tilts(jnp.asarray(weight), jnp.asarray(normal), given)
    np.testing.assert_allclose(found, expected, atol=1e-9)


SHAFT = [
    rectangle([-3.5, -2.5, -20.0], [7, 0, 0], [0, 0, 40]),
    rectangle([-3.5, 2.5, -20.0], [7, 0, 0], [0, 0, 40]),
    rectangle([-3.5, -2.5, -20.0], [0, 5, 0], [0, 0, 40]),
    rectangle([3.5, -2.5, -20.0], [0, 5, 0], [0, 0, 40]),
]
"""Four walls whose ends are out of sight."""


@jax.jit
def directions(vmap, points, T, params):
    frame = Frame(*anchor_of(T.translation(), params.map.voxel_size))
    kernel = params.registration.kernel
    matches = associate(vmap, points, jnp.ones(len(points), bool), T, frame, params.map)
    equations = linearise(matches, points, T, frame, kernel, params.lidar)
    return shown_by_noise(vmap, matches, points, T, frame, params.lidar, kernel, equations)


def found_in(surfaces, seed, reach=20.0, seen=20.0):
    truth = pose([0.3, -0.2, 0.1], [0.0, 0.0, 0.4])
    vmap = map_of(sample(surfaces, 12000, NOISE, seed=2 * seed, reach=reach), PARAMS)
    points = seen_from(truth, sample(surfaces, 2000, NOISE, seed=2 * seed + 1, reach=seen))
    rows = np.asarray(directions(vmap, points, truth, PARAMS))
    return rows[np.any(rows != 0, axis=1)]


@pytest.mark.parametrize("seed", range(4))
def test_smooth_walls_do_not_show_the_height(seed):
    # the scan does not reach the ends of what the map holds of the walls
    (row,) = found_in(SHAFT, seed, reach=8.0, seen=5.0)
    assert 0.99 < abs(row[2]) < 1 + 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_a_room_shows_all_directions(seed):
    assert not len(found_in(ROOM, seed))


@pytest.mark.parametrize("seed", range(2))
def test_a_corridor_does_not_show_the_way_along_it(seed):
    (row,) = found_in(box_room(200.0, 5.0, 4.0), seed)
    along = [np.cos(0.2), np.sin(0.2), 0.0]
    assert abs(row @ along) > 0.99
