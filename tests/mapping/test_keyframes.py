"""Keyframes: when one is due, which row it takes, and which are to be in the map."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.mapping.keyframes import (
    KeyframeCloud,
    Page,
    is_due,
    next_to_enter,
    no_keyframes,
    with_keyframe,
    with_page,
)
from tests.params import default_params

CORNERS, SURFACES = 8, 16
PARAMS = default_params().submap
_add = jax.jit(partial(with_keyframe, params=PARAMS))
_enter = jax.jit(partial(next_to_enter, params=PARAMS))
_page = jax.jit(partial(with_page, params=PARAMS))


def pose(x: float, y: float = 0.0, yaw: float = 0.0) -> jaxlie.SE3:
    return jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_z_radians(jnp.asarray(yaw)), jnp.array([x, y, 0.0])
    )


def cloud(number: int) -> KeyframeCloud:
    """Return points that identify their keyframe, with gaps between them."""
    rng = np.random.default_rng(number)
    masks = rng.uniform(size=CORNERS) < 0.5, rng.uniform(size=SURFACES) < 0.7
    points = [rng.normal(size=(count, 3)).astype(np.float32) for count in (CORNERS, SURFACES)]
    return KeyframeCloud(
        jnp.asarray(points[0]), jnp.asarray(masks[0]), jnp.asarray(points[1]), jnp.asarray(masks[1])
    )


def empty(capacity: int = 64):
    return no_keyframes(capacity, CORNERS, SURFACES, jnp.dtype(jnp.float64))


def added(keyframes, T, time: float, number: int = 0, keep: bool = True):
    return _add(keyframes, jnp.array(keep), T, jnp.asarray(time), cloud(number))


@pytest.mark.parametrize(
    ("moved", "due"),
    [
        (pose(1.999), False),
        (pose(2.001), True),
        (pose(1.0, yaw=0.199), False),
        (pose(1.0, yaw=-0.201), True),
        (pose(1.0, 0.99), False),
        (pose(0.0), True),
    ],
)
def test_a_keyframe_is_due_after_a_metre_or_a_fifth_of_a_radian(moved, due):
    assert bool(is_due(empty(), pose(0.0), PARAMS))
    assert bool(is_due(added(empty(), pose(1.0), 0.0), moved, PARAMS)) == due


def test_a_scan_that_is_none_leaves_everything_as_it_was():
    before = added(empty(), pose(0.0), 0.0, 1)
    after = added(before, pose(9.0), 1.0, 2, keep=False)
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_its_points_come_back_from_where_it_is():
    keyframes = empty()
    for number in range(30):
        keyframes = added(keyframes, pose(4.0 * number), float(number), number)
    # 116 m away and back: those beyond 50 m have to enter anew
    keyframes, _, nothing = _enter(keyframes, pose(116.0), jnp.asarray(60.0))
    assert not nothing.corner_mask.any()
    assert not nothing.surface_mask.any()
    seen = []
    for step in range(40):
        keyframes, T, found = _enter(keyframes, pose(0.0), jnp.asarray(61.0 + step))
        if not found.surface_mask.any():
            continue
        number = round(float(T.translation()[0]) / 4)
        seen.append(number)
        held = cloud(number)
        for got, mask, own, own_mask in (
            (found.corner, found.corner_mask, held.corner, held.corner_mask),
            (found.surface, found.surface_mask, held.surface, held.surface_mask),
        ):
            np.testing.assert_array_equal(np.asarray(got)[mask], np.asarray(own)[own_mask])
    # nearest first, each once
    assert seen == list(range(13))


def test_one_keyframe_per_two_metres_is_kept_for_later():
    keyframes = empty()
    for number in range(20):
        keyframes = added(keyframes, pose(float(number)), 0.1 * number, number)
    sparse = np.asarray(keyframes.sparse)[:20]
    np.testing.assert_array_equal(sparse, np.arange(20) % 2 == 0)


def test_rows_of_what_is_not_needed_any_more_are_taken_first():
    keyframes = empty(12)
    # a second apart, a metre apart: every other one is sparse; ten seconds are recent
    for number in range(30):
        keyframes = added(keyframes, pose(float(number)), float(number), number)
    held = np.sort(np.asarray(keyframes.time))
    # the last eleven are recent; of the older ones only one has room, and it is the last that was sparse
    np.testing.assert_array_equal(held[-11:], np.arange(19, 30))
    assert held[0] == 18
    assert int(keyframes.last) == int(np.argmax(np.asarray(keyframes.time)))


def page(keyframes, number: int, x: float, here: float):
    """Return the keyframes after a keyframe comes back, the vehicle being at ``here``."""
    back = Page(jnp.int32(number), pose(x), jnp.asarray(float(number)), cloud(number))
    return _page(keyframes, back, pose(here))


def drive(capacity: int, count: int):
    """Return keyframes four metres and four seconds apart: all are sparse, and three are recent."""
    keyframes = empty(capacity)
    for number in range(count):
        keyframes = added(keyframes, pose(4.0 * number), 4.0 * number, number)
    return keyframes


def numbers(keyframes) -> list[int]:
    return sorted(np.asarray(keyframes.number).tolist())


def test_the_farthest_keyframe_loses_its_row():
    keyframes = drive(8, 12)
    assert numbers(keyframes) == list(range(4, 12))
    # back again: the far ones are the latest
    keyframes = added(keyframes, pose(16.5), 100.0, 12)
    assert numbers(keyframes) == [4, 5, 6, 7, 8, 9, 10, 12]


def test_a_keyframe_comes_back_in_the_place_of_one_that_is_farther_away():
    keyframes = page(drive(8, 12), 3, 12.0, here=14.0)
    # 44 m is the farthest, but recent
    assert numbers(keyframes) == [3, 4, 5, 6, 7, 9, 10, 11]
    row = int(np.argmax(np.asarray(keyframes.number) == 3))
    assert bool(keyframes.sparse[row])
    keyframes, T, found = _enter(keyframes, pose(11.0), jnp.asarray(48.0))
    np.testing.assert_allclose(T.translation(), [12.0, 0.0, 0.0])
    held = cloud(3)
    np.testing.assert_array_equal(
        np.asarray(found.surface)[found.surface_mask], np.asarray(held.surface)[held.surface_mask]
    )


def test_a_keyframe_does_not_come_back_twice_nor_in_the_place_of_a_nearer_one():
    keyframes = drive(8, 12)
    for changed in (page(keyframes, 5, 20.0, here=20.0), page(keyframes, 0, 0.0, here=40.0)):
        jax.tree.map(np.testing.assert_array_equal, changed, keyframes)


def test_a_free_row_and_one_that_is_spent_are_taken_first():
    keyframes = page(drive(16, 12), 40, -9.0, here=0.0)
    assert numbers(keyframes)[-1] == 40
    assert numbers(keyframes).count(-1) == 3
    # at 1 m: within the spacing of the one at 0 m
    keyframes = added(drive(13, 12), pose(1.0), 48.0, 12)
    keyframes = added(keyframes, pose(60.0), 100.0, 13)
    assert numbers(keyframes) == [*range(12), 13]
