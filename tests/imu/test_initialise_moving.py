"""A moving vehicle finds velocity, gravity and biases from matched scans and inertial samples."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from lio_jax.core.error_state import ACCEL_BIAS, GYRO_BIAS, POSITION, ROTATION, VELOCITY
from lio_jax.core.types import ImuBatch
from lio_jax.imu.initialise_moving import MovingStart, initialise_moving
from tests.imu.motions import Pose, handheld, straight, truth_at, turning_car
from tests.params import default_params

PARAMS = default_params()
RATE, SPANS, PERIOD = 200, 10, 0.1
ROTATION_SIGMA, TRANSLATION_SIGMA = 1e-3, 0.01
T_IMU_LIDAR = jaxlie.SE3.from_rotation_and_translation(
    jaxlie.SO3.from_rpy_radians(0.02, -0.5, 1.0), jnp.array([0.3, -0.1, 0.4])
)
OFFSET = 0.013
GYRO_BIAS_TRUE = np.array([0.012, -0.008, 0.005])
ACCEL_BIAS_TRUE = np.array([0.05, -0.03, 0.08])

Start = Callable[..., MovingStart]


@pytest.fixture(scope="module")
def initialise() -> Start:
    compiled = jax.jit(initialise_moving)

    def run(imu: ImuBatch, poses: jaxlie.SE3, **changed: object) -> MovingStart:
        arguments = {"params": PARAMS.imu, "initial": PARAMS.initial, **changed}
        return compiled(
            imu,
            jnp.full(SPANS, -PERIOD),
            jnp.zeros(SPANS),
            poses,
            T_imu_lidar=T_IMU_LIDAR,
            time_offset=jnp.array(OFFSET),
            rotation_sigma=jnp.array(ROTATION_SIGMA),
            translation_sigma=jnp.array(TRANSLATION_SIGMA),
            **arguments,
        )

    return run


def samples(
    motion: Pose,
    rng: np.random.Generator | None = None,
    gyro_bias: np.ndarray = GYRO_BIAS_TRUE,
    accel_bias: np.ndarray = ACCEL_BIAS_TRUE,
) -> ImuBatch:
    """Return the batches of spans that end at 0.1, 0.2, ... s; noise where a generator is given."""
    count = round(SPANS * PERIOD * RATE) + 11
    grid = np.arange(-5, count - 5) / RATE
    truth = truth_at(motion, -5, count, RATE)
    gyro, accel = truth.rate + gyro_bias, truth.force + accel_bias
    if rng is not None:
        gyro = gyro + rng.normal(0, float(PARAMS.imu.gyro_noise) * RATE**0.5, gyro.shape)
        accel = accel + rng.normal(0, float(PARAMS.imu.accel_noise) * RATE**0.5, accel.shape)
    size, each = 40, round(PERIOD * RATE) + 11
    rows = np.arange(SPANS)[:, None] * round(PERIOD * RATE) + np.minimum(np.arange(size), each - 1)
    ends = (np.arange(SPANS) + 1) * PERIOD
    return ImuBatch(
        jnp.asarray(grid[rows] + OFFSET - ends[:, None]),
        jnp.asarray(gyro[rows]),
        jnp.asarray(accel[rows]),
        jnp.asarray(np.broadcast_to(np.arange(size) < each, rows.shape)),
    )


T_WORLD_TRUTH = jaxlie.SE3.from_rotation_and_translation(
    jaxlie.SO3.from_rpy_radians(0.7, -0.4, 2.0), jnp.array([30.0, -20.0, 5.0])
)
"""The matched poses' world is anyhow."""


def matched(
    motion: Pose, rng: np.random.Generator | None = None, world: jaxlie.SE3 = T_WORLD_TRUTH
) -> jaxlie.SE3:
    truth = truth_at(motion, 0, SPANS + 1, 1 / PERIOD)
    if rng is None:
        return _composed(world, truth.pose, T_IMU_LIDAR)
    noise = np.hstack(
        [rng.normal(0, TRANSLATION_SIGMA, (SPANS + 1, 3)), rng.normal(0, ROTATION_SIGMA, (SPANS + 1, 3))]
    )
    return _composed(world, truth.pose, T_IMU_LIDAR, jnp.asarray(noise))


@jax.jit
def _composed(
    world: jaxlie.SE3, body: jaxlie.SE3, lidar: jaxlie.SE3, noise: jax.Array | None = None
) -> jaxlie.SE3:
    poses = jax.vmap(lambda pose: world @ pose @ lidar)(body)
    return poses if noise is None else jax.vmap(lambda pose, d: pose @ jaxlie.SE3.exp(d))(poses, noise)


def level_truth(motion: Pose, poses: jaxlie.SE3, world: jaxlie.SE3) -> tuple[np.ndarray, ...]:
    """Return R_world_imu, position and velocity at the last pose.

    The world is upright in truth; its origin and heading are the matched pose's, with that pose's noise.
    """
    truth = truth_at(motion, 0, SPANS + 1, 1 / PERIOD)
    R = np.asarray(world.rotation().as_matrix())
    last = np.asarray((world @ jaxlie.SE3(truth.pose.wxyz_xyz[-1])).as_matrix())
    first = np.asarray((jaxlie.SE3(poses.wxyz_xyz[0]) @ T_IMU_LIDAR.inverse()).as_matrix())
    up = R[:, 2]
    # heading: the first pose's x axis, made level, lies in the plane of the level world's x axis
    ahead = first[:3, 0] - up * (up @ first[:3, 0])
    x = ahead / np.linalg.norm(ahead)
    level = np.stack([x, np.cross(up, x), up])
    return level @ last[:3, :3], level @ (last[:3, 3] - first[:3, 3]), level @ R @ truth.velocity[-1]


@dataclass(frozen=True)
class Case:
    """One start with its truth."""

    found: MovingStart
    error: np.ndarray
    """The 15 errors in the order of the error state."""


def case(
    initialise: Start,
    motion: Pose,
    rng: np.random.Generator | None = None,
    world: jaxlie.SE3 = T_WORLD_TRUTH,
    biases: tuple[np.ndarray, np.ndarray] = (GYRO_BIAS_TRUE, ACCEL_BIAS_TRUE),
) -> Case:
    poses = matched(motion, rng, world)
    found = initialise(samples(motion, rng, *biases), poses)
    R, position, velocity = level_truth(motion, poses, world)
    nav = found.start.nav
    estimate = np.asarray(nav.T_world_imu.rotation().as_matrix())
    error = np.concatenate(
        [
            Rotation.from_matrix(estimate.T @ R).as_rotvec(),
            estimate.T @ (position - nav.T_world_imu.translation()),
            estimate.T @ (velocity - nav.velocity),
            biases[0] - nav.gyro_bias,
            biases[1] - nav.accel_bias,
        ]
    )
    return Case(found, error)


MOTIONS = pytest.mark.parametrize(
    "motion", [straight, turning_car, handheld], ids=lambda motion: motion.__name__
)
NONE = (np.zeros(3), np.zeros(3))


@MOTIONS
def test_without_noise_and_bias_the_state_is_exact(initialise, motion):
    """The remaining error comes from sampling at 200 Hz."""
    at = case(initialise, motion, biases=NONE)
    assert bool(at.found.is_good)
    bounds = ((ROTATION, 2e-4), (POSITION, 2e-4), (VELOCITY, 1e-3), (GYRO_BIAS, 1e-4), (ACCEL_BIAS, 2e-3))
    for part, bound in bounds:
        assert np.linalg.norm(at.error[part]) < bound, part
    assert float(at.found.residual) < 0.05


@MOTIONS
def test_biases_are_found_as_far_as_the_motion_shows_them(initialise, motion):
    at = case(initialise, motion)
    assert bool(at.found.is_good)
    assert np.linalg.norm(at.error[GYRO_BIAS]) < 0.1 * np.linalg.norm(GYRO_BIAS_TRUE)
    # bias across gravity passes for tilt: no more than bias over gravity
    assert np.linalg.norm(at.error[ROTATION]) < 1.2 * np.linalg.norm(ACCEL_BIAS_TRUE) / 9.8
    assert np.linalg.norm(at.error[VELOCITY]) < 0.1
    assert np.linalg.norm(at.error[ACCEL_BIAS]) < np.linalg.norm(ACCEL_BIAS_TRUE)


@MOTIONS
def test_errors_are_as_large_as_the_covariance_says(initialise, motion):
    """Average normalised errors squared of the parts lie in their 99 % bands."""
    rng = np.random.default_rng(0)
    runs = 60
    parts = {"rotation": ROTATION, "velocity": VELOCITY, "gyro": GYRO_BIAS, "accel": ACCEL_BIAS}
    parts |= {"position": POSITION, "all": slice(0, 15)}
    total = dict.fromkeys(parts, 0.0)
    residuals = []
    for _ in range(runs):
        gyro = rng.normal(0, float(PARAMS.initial.gyro_bias_sigma), 3)
        accel = rng.normal(0, float(PARAMS.initial.accel_bias_sigma), 3)
        at = case(initialise, motion, rng, biases=(gyro, accel))
        assert bool(at.found.is_good)
        residuals.append(float(at.found.residual))
        covariance = np.asarray(at.found.start.covariance)
        for name, part in parts.items():
            total[name] += at.error[part] @ np.linalg.solve(covariance[part, part], at.error[part]) / runs
    for name, part in parts.items():
        low, high = chi2.ppf([0.005, 0.995], (part.stop - part.start) * runs) / runs
        assert low < total[name] < high, name
    assert np.mean(residuals) == pytest.approx(1.0, abs=0.1)


def test_the_map_can_be_moved_along(initialise):
    poses = matched(turning_car)
    found = initialise(samples(turning_car), poses)
    moved = found.T_level_world @ jaxlie.SE3(poses.wxyz_xyz[-1]) @ T_IMU_LIDAR.inverse()
    np.testing.assert_allclose(
        moved.as_matrix(), found.start.nav.T_world_imu.as_matrix(), atol=TRANSLATION_SIGMA / 3
    )
    first = found.T_level_world @ jaxlie.SE3(poses.wxyz_xyz[0]) @ T_IMU_LIDAR.inverse()
    np.testing.assert_allclose(first.translation(), 0, atol=1e-9)
    assert float(first.rotation().as_rpy_radians().yaw) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("roll", [0.0, np.pi, np.pi / 2])
def test_the_matched_world_may_lie_any_way(initialise, roll):
    world = jaxlie.SE3.from_rotation(jaxlie.SO3.from_x_radians(jnp.array(roll)))
    at = case(initialise, turning_car, world=world, biases=NONE)
    assert bool(at.found.is_good)
    assert np.linalg.norm(at.error) < 5e-3


def test_velocities_at_all_poses_are_the_truths_speeds(initialise):
    found = case(initialise, turning_car, biases=NONE).found
    speeds = np.linalg.norm(truth_at(turning_car, 0, SPANS + 1, 1 / PERIOD).velocity, axis=1)
    np.testing.assert_allclose(np.linalg.norm(found.velocity, axis=1), speeds, atol=5e-3)


def test_zero_sigmas_keep_the_biases_at_zero(initialise):
    frozen = eqx.tree_at(
        lambda p: (p.gyro_bias_sigma, p.accel_bias_sigma), PARAMS.initial, (jnp.zeros(()), jnp.zeros(()))
    )
    found = initialise(samples(turning_car, None, *NONE), matched(turning_car), initial=frozen)
    nav = found.start.nav
    np.testing.assert_array_equal(np.concatenate([nav.gyro_bias, nav.accel_bias]), 0.0)
    assert np.all(np.diagonal(found.start.covariance)[GYRO_BIAS] == 0)
    assert bool(found.is_good)


def bad(kind: str) -> tuple[ImuBatch, jaxlie.SE3]:
    imu, poses = samples(turning_car), matched(turning_car)
    if kind == "accelerometer in g":
        imu = eqx.tree_at(lambda b: b.accel, imu, imu.accel / 9.80665)
    elif kind == "gyro in deg/s":
        imu = eqx.tree_at(lambda b: b.gyro, imu, jnp.rad2deg(imu.gyro))
    elif kind == "accelerometer of opposite sign":
        imu = eqx.tree_at(lambda b: b.accel, imu, -imu.accel)
    elif kind == "no samples":
        imu = eqx.tree_at(lambda b: b.mask, imu, jnp.zeros_like(imu.mask))
    elif kind == "scan matching lost":
        jump = jnp.where(jnp.arange(SPANS + 1) > 5, 1.0, 0.0)
        poses = jaxlie.SE3(poses.wxyz_xyz.at[:, 4].add(jump))
    elif kind == "a pose is NaN":
        poses = jaxlie.SE3(poses.wxyz_xyz.at[3].set(jnp.nan))
    return imu, poses


@pytest.mark.parametrize(
    "kind",
    [
        "accelerometer in g",
        "gyro in deg/s",
        "accelerometer of opposite sign",
        "no samples",
        "scan matching lost",
        "a pose is NaN",
    ],
)
def test_what_does_not_fit_is_no_good_start(initialise, kind):
    assert not bool(initialise(*bad(kind)).is_good)
