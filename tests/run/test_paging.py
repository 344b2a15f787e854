"""Keyframes without a row on the device are kept on the host, and come back where the vehicle meets them."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.mapping.keyframes import Page
from lio_jax.run.paging import KeyframePager
from lio_jax.settings.settings import recipe_settings

CORNERS, SURFACES = 6, 10
PARAMS = recipe_settings("lio_sam").params()


@dataclass(frozen=True)
class Echo:
    """A recipe whose state is the page that came back last."""

    def with_page(self, params: Any, state: Any, page: Page) -> Any:
        """Return the page."""
        return page


def cloud(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points in the lidar frame, corners first, and which are real."""
    random = np.random.default_rng(number)
    points = random.normal(0, 20, (CORNERS + SURFACES, 3)).astype(np.float32)
    return points, random.random(CORNERS + SURFACES) < 0.6


def pose(x: float, yaw: float = 0.4) -> np.ndarray:
    return np.array([*Rotation.from_euler("z", yaw).as_quat(scalar_first=True), x, 1.0, 2.0])


def output(number: int, x: float, rows: list[int], sparse: bool = True) -> Any:
    """Return the output of a scan that is the keyframe ``number``, or none if that is -1."""
    points, mask = cloud(number + 1)
    T = pose(x)
    origin = np.array([x + 3.0, 0.5, 1.5])
    in_world = points @ Rotation.from_quat(T[:4], scalar_first=True).as_matrix().T + T[4:] - origin
    return SimpleNamespace(
        registration=SimpleNamespace(T_world_lidar=jaxlie.SE3(jnp.asarray(T))),
        points=in_world.astype(np.float32),
        points_mask=mask,
        corners=np.arange(CORNERS + SURFACES) < CORNERS,
        origin=origin,
        keyframes=SimpleNamespace(
            numbers=np.array(rows, np.int32), added=np.int32(number), sparse=sparse, time=float(number)
        ),
    )


@pytest.fixture
def pager():
    return KeyframePager(Echo(), PARAMS)


def test_what_has_a_row_does_not_come_back(pager):
    for number in range(5):
        pager.take(output(number, 2.0 * number, list(range(number + 1))))
    assert pager.paged("state") == "state"


def test_the_nearest_without_a_row_comes_back_with_its_points(pager):
    for number in range(5):
        pager.take(output(number, 2e6 + 2.0 * number, list(range(number + 1))))
    pager.take(output(-1, 2e6 + 3.0, [-1, 0, 3, 4]))
    page = pager.paged(jnp.zeros(()))
    assert int(page.number) == 1
    assert float(page.time) == 1.0
    np.testing.assert_array_equal(page.T_world_lidar.wxyz_xyz, pose(2e6 + 2.0))
    points, mask = cloud(2)
    for seen, real, part in (
        (page.cloud.corner, page.cloud.corner_mask, slice(0, CORNERS)),
        (page.cloud.surface, page.cloud.surface_mask, slice(CORNERS, None)),
    ):
        np.testing.assert_allclose(np.asarray(seen)[real], points[part][mask[part]], atol=2e-5)
        assert len(seen) == len(mask[part])


def test_what_is_far_or_was_only_recent_stays_away(pager):
    pager.take(output(0, 0.0, [0]))
    pager.take(output(1, 60.0, [1], sparse=False))
    pager.take(output(2, 61.0, [2]))
    assert pager.paged("state") == "state"
    pager.take(output(-1, 49.0, [2]))
    assert int(pager.paged(jnp.zeros(())).number) == 0


def test_many_keyframes_are_kept(pager):
    for number in range(300):
        pager.take(output(number, 2.0 * number, [number]))
    pager.take(output(-1, 250.0, [299]))
    assert int(pager.paged(jnp.zeros(())).number) == 125


def test_a_corrected_keyframe_comes_back_where_it_now_lies(pager):
    for number in range(3):
        pager.take(output(number, 40.0 * number, [number]))
    there = np.stack([pose(1040.0 - 40.0 * number, yaw=1.0) for number in range(3)])
    move = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.identity(), jnp.array([960.0, 0.0, 0.0]))
    pager.moved(move, there)
    # the vehicle is at 1040 m, where the first keyframe now lies
    page = pager.paged(jnp.zeros(()))
    assert int(page.number) == 0
    np.testing.assert_array_equal(page.T_world_lidar.wxyz_xyz, there[0])
