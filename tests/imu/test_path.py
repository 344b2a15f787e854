"""The pose at any time against an integration of the equations of motion, and deskewing along it."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from lio_jax.imu.path import Path, carry, deskew_along, pose_at
from lio_jax.imu.strapdown import path_along
from tests.imu.motion import ideal_imu, nav_at, pose_matrix, quick_jit

ORIGIN = 1.0
END = 0.1
poses = quick_jit(lambda path, time: pose_at(path, time).as_matrix())
deskew = quick_jit(deskew_along)
carried = quick_jit(carry)


@pytest.fixture(scope="module")
def path() -> Path:
    imu = ideal_imu(ORIGIN - 0.003 + 0.005 * np.arange(22), ORIGIN)
    return quick_jit(path_along)(nav_at(ORIGIN), imu, jnp.asarray(0.0), jnp.asarray(END))


def test_pose_between_knots_solves_the_equations_of_motion(path: Path) -> None:
    """Integrate R' = R w, p'' = R f + g through the whole path, interval by interval."""
    gravity = np.asarray(path.gravity)
    state = np.concatenate([pose_matrix(ORIGIN)[:3].ravel(), path.velocity[0]])
    for i in range(len(path.rate)):
        begin, end = float(path.time[i]), float(path.time[i + 1])
        if end == begin:
            continue
        spin, force = np.cross(np.eye(3), path.rate[i]), np.asarray(path.accel[i])

        def slope(_, s, spin=spin, force=force):
            rotation = s[:12].reshape(3, 4)[:, :3]
            moving = np.hstack([rotation @ spin, s[12:, None]])
            return np.concatenate([moving.ravel(), rotation @ force + gravity])

        middle = (begin + end) / 2
        found = solve_ivp(slope, (begin, end), state, rtol=1e-12, atol=1e-12, t_eval=[middle, end])
        expected = found.y[:12].T.reshape(2, 3, 4)
        got = poses(path, jnp.asarray([middle, end]))
        np.testing.assert_allclose(got[:, :3], expected, atol=1e-9)
        state = found.y[:, 1]
    np.testing.assert_allclose(state[12:], path.velocity[-1], atol=1e-9)


def test_pose_is_that_of_the_true_motion(path: Path) -> None:
    times = np.linspace(0, END, 41)
    expected = np.stack([pose_matrix(ORIGIN + t) for t in times])
    np.testing.assert_allclose(poses(path, jnp.asarray(times)), expected, atol=3e-5)


def test_the_motion_goes_on_beyond_both_ends(path: Path) -> None:
    got = poses(path, jnp.asarray([-0.005, END + 0.005]))
    expected = np.stack([pose_matrix(ORIGIN - 0.005), pose_matrix(ORIGIN + END + 0.005)])
    np.testing.assert_allclose(got, expected, atol=2e-3)


def test_carry_is_the_pose_applied(path: Path) -> None:
    rng = np.random.default_rng(0)
    times, points = jnp.asarray(rng.uniform(0, END, 50)), jnp.asarray(20 * rng.normal(size=(50, 3)))
    expected = jnp.einsum(
        "nij,nj->ni", poses(path, times), jnp.pad(points, ((0, 0), (0, 1)), constant_values=1)
    )
    np.testing.assert_allclose(carried(path, times, points), expected[:, :3], atol=1e-12)


@pytest.mark.parametrize("rate", [3.0, 25.0])
def test_an_interval_may_turn_far(rate: float) -> None:
    """Samples 0.2 s apart at 25 rad/s turn by 5 rad in one interval."""
    axis = np.array([0.6, 0.0, 0.8])
    path = Path(
        time=jnp.array([0.0, 0.2]),
        T_world_imu=jaxlie.SE3(jnp.tile(jnp.array([1.0, 0, 0, 0, 0, 0, 0]), (2, 1))),
        velocity=jnp.zeros((2, 3)),
        rate=jnp.asarray(rate * axis)[None],
        accel=jnp.zeros((1, 3)),
        gravity=jnp.zeros(3),
    )
    times = np.linspace(0, 0.2, 9)
    point = np.array([10.0, -20.0, 5.0])
    expected = Rotation.from_rotvec(rate * times[:, None] * axis).apply(point)
    got = carried(path, jnp.asarray(times), jnp.tile(jnp.asarray(point), (9, 1)))
    np.testing.assert_allclose(got, expected, atol=2e-5)


def seen_points(count: int, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return fixed world points as seen by the moving lidar, their times, and as seen from the last pose."""
    rng = np.random.default_rng(1)
    world = 15 * rng.normal(size=(count, 3)) + offset
    times = rng.uniform(0, END, count)
    extrinsic = np.asarray(nav_at(0.0).T_imu_lidar.as_matrix())

    def seen(time: float, point: np.ndarray) -> np.ndarray:
        lidar = pose_matrix(ORIGIN + time) @ extrinsic
        lidar[:3, 3] += offset
        return np.linalg.solve(lidar, [*point, 1])[:3]

    points = np.stack([seen(t, p) for t, p in zip(times, world, strict=True)])
    return points, times, np.stack([seen(END, p) for p in world])


@pytest.mark.parametrize("kilometres", [0.0, 5.0])
def test_deskewed_points_stand_still(path: Path, kilometres: float) -> None:
    """Far from the world's origin too, where positions in float32 are off by half a millimetre."""
    offset = np.array([1e3 * kilometres, 0, 0])
    points, times, expected = seen_points(40, offset)
    pose = path.T_world_imu
    moved = jaxlie.SE3.from_rotation_and_translation(pose.rotation(), pose.translation() + offset)
    far = dataclasses.replace(path, T_world_imu=moved)
    got = deskew(
        far,
        nav_at(0.0).T_imu_lidar,
        jnp.asarray(points, jnp.float32),
        jnp.asarray(times, jnp.float32),
    )
    assert got.dtype == jnp.float32
    assert np.abs(points - expected).max() > 1
    np.testing.assert_allclose(got, expected, atol=1e-3)


def carried_along(direction: tuple, path: Path, times, points, by: float):
    """Return where the points are after a step along a direction of everything that moves them."""
    moved = jax.tree.map(lambda x, dx: x + by * dx, (path, times, points), direction)
    return carry(*moved)


@pytest.mark.parametrize("still", [False, True])
def test_derivatives_are_finite_differences(path: Path, still: bool) -> None:
    """By knots, poses, velocities, rates, forces, gravity, times and points, in both modes."""
    rng = np.random.default_rng(2)
    path = dataclasses.replace(path, rate=jnp.zeros_like(path.rate)) if still else path
    moved = (path, jnp.asarray(rng.uniform(0, END, 20)), jnp.asarray(rng.normal(size=(20, 3))))
    direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), moved)
    h = 1e-6
    at = quick_jit(lambda by: carried_along(direction, *moved, by))
    difference = (at(h) - at(-h)) / (2 * h)
    forward = quick_jit(lambda: jax.jvp(carry, moved, direction)[1])()
    np.testing.assert_allclose(forward, difference, rtol=1e-6, atol=1e-6)

    weights = jnp.asarray(rng.normal(size=(20, 3)))
    slopes = quick_jit(jax.grad(lambda moved: jnp.sum(weights * carry(*moved))))(moved)
    along = sum(jax.tree.leaves(jax.tree.map(lambda g, d: jnp.sum(g * d), slopes, direction)))
    np.testing.assert_allclose(along, jnp.sum(weights * difference), rtol=1e-6)


@pytest.mark.parametrize("still", [False, True])
def test_gradients_of_poses_are_finite_differences(path: Path, still: bool) -> None:
    rng = np.random.default_rng(3)
    times = jnp.asarray(rng.uniform(0, END, 20))

    def value(rate):
        return jnp.sum(pose_at(dataclasses.replace(path, rate=rate), times).log())

    rate = jnp.zeros_like(path.rate) if still else path.rate
    along, h = jnp.asarray(rng.normal(size=rate.shape)), 1e-6
    sums = quick_jit(jax.value_and_grad(value))
    difference = (sums(rate + h * along)[0] - sums(rate - h * along)[0]) / (2 * h)
    np.testing.assert_allclose(jnp.sum(sums(rate)[1] * along), difference, rtol=1e-6)
