"""Movers: closed paths of any duration, uniform motion in between, and paths that belong together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.sim.primitives import Boxes
from lio_jax.sim.traffic import Loop, car_boxes, traffic
from lio_jax.sim.worlds import Movers, moving_boxes

STEPS, PERIOD = 400, 20.0

_boxes = jax.jit(moving_boxes)


@pytest.fixture(scope="module")
def circling():
    """Two boxes of one body on a circle of 10 m, and one of another body that goes the other way."""
    angle = 2 * np.pi * np.arange(STEPS) / STEPS
    circle = np.stack([10 * np.cos(angle), 10 * np.sin(angle), 0 * angle + 1], axis=1)
    back = circle * [1, -1, 2]
    center = jnp.array([[1.0, 0.0, 0.2], [-1.0, 0.5, 0.0], [0.0, 0.0, 0.0]])
    boxes = Boxes(center, jnp.ones((3, 3)), jnp.zeros(3), jnp.full(3, 0.5))
    return Movers(
        jnp.asarray(np.stack([circle, back])),
        jnp.asarray(np.stack([angle + np.pi / 2, -angle - np.pi / 2])),
        jnp.array([PERIOD, PERIOD / 2]),
        jnp.array([0, 0, 1], jnp.int32),
        boxes,
    )


@pytest.mark.parametrize("time", [0.0, 3.3, 19.99, 123.4, 3599.7])
def test_boxes_are_where_the_circle_says(circling, time):
    moving = _boxes(circling, jnp.asarray(time))
    angle = 2 * np.pi * time / PERIOD
    ahead, left = np.array([-np.sin(angle), np.cos(angle)]), np.array([-np.cos(angle), -np.sin(angle)])
    middle = -10 * left
    sag = 10 * (np.pi / STEPS) ** 2  # of a chord below its arc, and what turns with it
    np.testing.assert_allclose(moving.boxes.center[0], [*(middle + ahead), 1.2], atol=2 * sag)
    np.testing.assert_allclose(moving.boxes.center[1], [*(middle - ahead + 0.5 * left), 1.0], atol=2 * sag)
    np.testing.assert_allclose(moving.velocity[:2, :2], 2 * [np.pi * ahead], atol=0.03)
    heading = np.arctan2(ahead[1], ahead[0])
    np.testing.assert_allclose(np.cos(moving.boxes.yaw[:2] - heading), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(moving.velocity[2]), 2 * np.pi, rtol=1e-3)
    np.testing.assert_allclose(moving.boxes.center[2, 2], 2.0)


def test_velocity_carries_a_box_along_its_path(circling):
    step = 0.02
    for time in (1.001, 7.501, 19.951):
        now, then = (_boxes(circling, jnp.asarray(when)) for when in (time, time + step))
        # the body's centre; its boxes turn about it besides
        np.testing.assert_allclose(
            now.boxes.center[2] + step * now.velocity[2], then.boxes.center[2], atol=1e-3
        )


def test_no_jump_from_lap_to_lap(circling):
    before, after = (_boxes(circling, jnp.asarray(PERIOD + sign * 1e-6)) for sign in (-1, 1))
    np.testing.assert_allclose(before.boxes.center, after.boxes.center, atol=1e-4)
    np.testing.assert_allclose(np.cos(before.boxes.yaw - after.boxes.yaw), 1, atol=1e-9)


@pytest.fixture(scope="module")
def two_loops():
    loops = [Loop((0.0, 0.0), (60.0, 40.0), 5.0, 8.0, 3), Loop((100.0, 0.0), (130.0, 90.0), 4.0, 6.0, 1)]
    one = car_boxes(np.zeros((1, 3)), np.zeros(1), np.full(1, 4.5), np.full(1, 1.5), np.full(1, 0.5))
    return loops, traffic(loops, lambda points: 0.01 * points[:, 0], [one] * 4, np.random.default_rng(0))


def test_loops_are_clockwise_rounded_rectangles(two_loops):
    loops, made = two_loops
    for body, loop in ((0, loops[0]), (3, loops[1])):
        path, yaw = made.path[body, :, :2], made.yaw[body]
        np.testing.assert_allclose(path.min(axis=0), loop.low, atol=1e-2)
        np.testing.assert_allclose(path.max(axis=0), loop.high, atol=1e-2)
        steps = np.roll(path, -1, axis=0) - path
        length = np.linalg.norm(steps, axis=1)
        # chords of arcs are a little shorter than the even steps along the path
        assert length.max() / length.min() < 1.01
        assert length.sum() / made.period[body] == pytest.approx(loop.speed, rel=5e-3)
        heading = np.arctan2(steps[:, 1], steps[:, 0])
        assert np.abs(np.angle(np.exp(1j * (heading - yaw)))).max() < 0.1
        area = 0.5 * np.sum(path[:, 0] * np.roll(path[:, 1], -1) - path[:, 1] * np.roll(path[:, 0], -1))
        size = np.subtract(loop.high, loop.low)
        assert area == pytest.approx(-(size[0] * size[1] - (4 - np.pi) * loop.radius**2), rel=1e-3)


def test_bodies_of_a_loop_keep_their_distance_and_the_ground(two_loops):
    _, made = two_loops
    for first, second in ((0, 1), (1, 2), (0, 2)):
        assert np.linalg.norm(made.path[first] - made.path[second], axis=1).min() > 20
    np.testing.assert_allclose(made.path[..., 2], 0.01 * made.path[..., 0])
    np.testing.assert_array_equal(made.body, np.repeat(np.arange(4), 2))


def test_a_car_stands_on_the_ground_with_its_cabin_on_top():
    center = np.array([[3.0, 4.0, 10.0]])
    body, cabin = car_boxes(center, np.array([0.3]), np.array([4.4]), np.array([1.6]), np.array([0.5]))
    np.testing.assert_allclose(body[:2], [3, 4])
    assert 10.1 <= body[2] - body[5] <= 10.25
    np.testing.assert_allclose(cabin[2] - cabin[5], body[2] + body[5])
    np.testing.assert_allclose(cabin[2] + cabin[5], 11.6)
