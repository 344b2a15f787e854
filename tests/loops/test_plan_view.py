"""Fits of one place on another from above: where they are, and that all of them are seen."""

import numpy as np
import pytest

from lio_jax.loops.verification import SOURCE_REACH, fits, upright_cells
from tests.loops.places import pillars, pose, seen_from


def cells_of(points, reach):
    inside = np.abs(points[:, :2]).max(axis=1) < reach
    return upright_cells(points[inside].astype(np.float32))[0]


def test_upright_things_are_those_of_some_height_in_a_cell():
    ground = np.stack(np.meshgrid(np.arange(-5, 5, 0.3), np.arange(-5, 5, 0.3)), -1).reshape(-1, 2)
    slope = np.column_stack([ground, 0.1 * ground[:, 0]])
    post = np.column_stack([np.full((10, 2), 2.5), np.linspace(0, 3, 10)])
    cells, upright = upright_cells(np.concatenate([slope, post]).astype(np.float32))
    assert np.count_nonzero(cells) == 1
    assert upright[-10:].all()
    assert upright.sum() < 30


@pytest.mark.parametrize(
    ("shift", "turn"), [((0.0, 0.0), 0.0), ((7.0, -11.0), 0.6), ((-15.0, 3.0), -0.8), ((2.5, 0.5), 0.33)]
)
def test_the_fit_is_found_anywhere_in_the_window(shift, turn):
    world = pillars(3, count=80, reach=60.0)
    source = seen_from(pose(*shift, yaw=turn), world)
    found = fits(cells_of(source, SOURCE_REACH), cells_of(world, 64.0), 0.0, 1.0, np.zeros(2), 16.0, 5)
    assert np.linalg.norm(found.shift[0] - shift) < 1.1
    assert abs(found.turn[0] - turn) < 0.06
    assert found.share[0] > 1.5 * found.share[1]
    assert np.all(np.diff(found.share) <= 0)


def test_the_guess_and_its_error_bound_the_search():
    world = pillars(3, count=80, reach=60.0)
    source = cells_of(seen_from(pose(9.0, 0.0), world), SOURCE_REACH)
    found = fits(source, cells_of(world, 64.0), 0.0, 0.1, np.array([2.0, 0.0]), 3.0, 5)
    assert np.all(np.linalg.norm(found.shift - [2.0, 0.0], axis=1) <= 3.0)
    assert np.all(np.abs(found.turn) <= 0.1 + 1e-9)


def test_a_place_that_repeats_itself_has_rivals_as_good():
    row = np.stack([np.arange(-100.0, 100.0, 6.0) + 0.5, np.full(34, 5.5)], axis=1)
    posts = np.concatenate(
        [np.column_stack([np.tile(place, (8, 1)), np.linspace(-1, 4, 8)]) for place in row]
    )
    posts = np.concatenate([posts, posts * [1, -1, 1]])
    found = fits(cells_of(posts, SOURCE_REACH), cells_of(posts, 64.0), 0.0, 0.1, np.zeros(2), 14.0, 7)
    equal = found.share > 0.95 * found.share[0]
    assert sorted(found.shift[equal].tolist()) == [[x, 0.0] for x in (-12.0, -6.0, 0.0, 6.0, 12.0)]
