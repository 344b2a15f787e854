"""The measurements of a fusion, its unknowns, and the residuals between them.

Each pose of the odometry has a state: pose, velocity and biases of the IMU, and the odometry's own white
error there. The common unknowns are the pose of the odometry's sensor in the IMU frame, the odometry's scale,
its constant turn per way, its clock, and the pose of the world in a level frame: the frame of the fixes, or
else one whose direction of gravity alone is found. The world is that of the odometry's first pose.

The odometry's pose z of a scan is matched with a map that the odometry drew itself, so z has a white error e
that the next pose does not inherit, and a drift that all later poses inherit: with sensor poses s,
(z_k exp(e_k))^-1 z_(k+1) exp(e_(k+1)) = s_k^-1 s_(k+1) exp(w_k). White relative errors alone would be wrong,
because errors of such an odometry are anticorrelated from step to step.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int32

from lio_jax.core.geometry import rotation_matrix, skew
from lio_jax.estimation.factors import FLOOR
from lio_jax.estimation.motion_state import MotionState
from lio_jax.fusion.params import FusionParams
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import Preintegrated

NODE_DOF = 21
"""Error of a state: that of a motion state (15), then the odometry's white error (rotation, translation)."""
COMMON_DOF = 18
"""Error of the common unknowns, in the order of :class:`Common`; the level rotation's is in level axes."""
STILL_SPEED = 0.1
"""Speed, m/s, whose way counts for the drift of an odometry at rest."""
_EXACT = 1e-6
"""Smallest standard deviation of a prior: zero means exact."""
_FIRST_POSE = (1e-5,) * 3 + (1e-4,) * 3
"""Standard deviations of the first pose, rad and m: it defines the world."""
_LEVEL_YAW, _LEVEL_ORIGIN = 1e-4, 1e-3
"""Standard deviations, rad and m, of what no fix observes."""
_WIDE_TURN, _WIDE_ORIGIN = 10.0, 1e5


class Fixes(eqx.Module):
    """GPS fixes, each between two states."""

    link: Int32[Array, " g"]
    """Row of the state before the fix."""
    share: Float[Array, " g"]
    """Time since that state as a share of the time to the next one."""
    position: Float[Array, "g 3"]
    """Measured position of the antenna, m, in the level frame."""
    sigma: Float[Array, "g 3"]
    """Standard deviations, m."""


class UnitCovariances(eqx.Module):
    """Covariance of preintegrated links as a sum over squared densities: it is linear in them."""

    unit: Float[Array, "4 m 15 15"]
    """For a density of one of gyroscope, accelerometer, and of the walks of both biases."""
    rest: Float[Array, "m 15 15"]
    """From gaps and sparse samples, whatever the densities are."""

    def of(self, imu: ImuParams) -> Float[Array, "m 15 15"]:
        """Return the covariances for given densities."""
        densities = jnp.stack([imu.gyro_noise, imu.accel_noise, imu.gyro_bias_walk, imu.accel_bias_walk])
        floor = jnp.diag(jnp.asarray(FLOOR, self.rest.dtype) ** 2)
        return jnp.einsum("s,smij->mij", densities**2, self.unit) + self.rest + floor


class Problem(eqx.Module):
    """All measurements of a fusion with n poses and m = n - 1 links."""

    odometry: Float[Array, "n 7"]
    """Poses of the odometry's sensor in its world, quaternion w x y z and position, m."""
    time: Float[Array, " n"]
    """Time of each pose since the first, s."""
    gyro: Float[Array, "n 3"]
    """Measured angular rate at each pose, rad/s, IMU frame."""
    imu: Preintegrated
    """Preintegrated samples of each link."""
    covariance: UnitCovariances
    """Covariance of each link."""
    level: Float[Array, "7"]
    """First guess of the pose of the world in the level frame, quaternion w x y z and position, m."""
    mounting: Float[Array, "7"]
    """Prior mean of the pose of the odometry's sensor in the IMU frame."""
    fixes: Fixes
    """GPS fixes; none has g = 0."""


class Common(NamedTuple):
    """The common unknowns."""

    T_imu_sensor: jaxlie.SE3
    log_scale: Array
    """Logarithm of the odometry's length over the true one."""
    turn: Array
    """Constant turn of the odometry per way, rad/m, (3,), sensor frame."""
    T_level_world: jaxlie.SE3
    time_offset: Array
    """What has to be added to the odometry's stamps, s."""
    fix_offset: Array
    """What has to be added to the fixes' stamps, s."""


class FusedStates(eqx.Module):
    """Unknowns of a fusion, packed: loops over few arrays are fast."""

    motion: Float[Array, "n 22"]
    """Quaternion w x y z and position of the IMU in world, velocity, biases of gyroscope and accelerometer,
    and the odometry's white error: rotation (rad) and translation (m), sensor frame."""
    common: Float[Array, "20"]
    """T_imu_sensor (7), logarithm of the scale, turn per way (3), T_level_world (7), and the clock offsets of
    the odometry and of the fixes."""

    def motion_states(self) -> MotionState:
        """Return pose, velocity and biases of each state."""
        return motion_of(self.motion)

    def unpacked(self) -> Common:
        """Return the common unknowns."""
        return common_of(self.common)

    def retract(self, nodes: Float[Array, "n 21"], common: Float[Array, "18"]) -> "FusedStates":
        """Return the unknowns with errors applied."""
        return FusedStates(retract_node(self.motion, nodes), retract_common(self.common, common))


def motion_of(node: Float[Array, "*b 22"]) -> MotionState:
    """Return pose, velocity and biases of a packed state."""
    return MotionState(jaxlie.SE3(node[..., :7]), node[..., 7:10], node[..., 10:13], node[..., 13:16])


def common_of(packed: Float[Array, "20"]) -> Common:
    """Return the packed common unknowns by name."""
    return Common(
        jaxlie.SE3(packed[:7]), packed[7], packed[8:11], jaxlie.SE3(packed[11:18]), packed[18], packed[19]
    )


def retract_node(node: Float[Array, "*b 22"], error: Float[Array, "*b 21"]) -> Float[Array, "*b 22"]:
    """Return a packed state with its error applied."""
    moved = motion_of(node).retract(error[..., :15])
    parts = (moved.T_world_imu.wxyz_xyz, moved.velocity, moved.gyro_bias, moved.accel_bias)
    return jnp.concatenate([*parts, node[..., 16:] + error[..., 15:]], axis=-1)


def retract_common(packed: Float[Array, "20"], error: Float[Array, "18"]) -> Float[Array, "20"]:
    """Return the packed common unknowns with their error applied."""
    mounting = (jaxlie.SO3(packed[:4]) @ jaxlie.SO3.exp(error[:3])).normalize().wxyz
    level = (jaxlie.SO3.exp(error[10:13]) @ jaxlie.SO3(packed[11:15])).normalize().wxyz
    return jnp.concatenate(
        [
            mounting,
            packed[4:11] + error[3:10],
            level,
            packed[15:20] + error[13:18],
        ]
    )


def _sensor_pose(node: Array, gyro: Array, common: Common) -> jaxlie.SE3:
    """Return the pose of the odometry's sensor in world when the odometry's stamp says so."""
    state = motion_of(node)
    turn = jaxlie.SO3.exp((gyro - state.gyro_bias) * common.time_offset)
    rotation = state.T_world_imu.rotation() @ turn
    position = state.T_world_imu.translation() + state.velocity * common.time_offset
    return jaxlie.SE3.from_rotation_and_translation(rotation, position) @ common.T_imu_sensor


def _difference(pose: jaxlie.SE3, other: jaxlie.SE3) -> Array:
    """Return rotation and translation of ``other`` in the frame of ``pose``, (6,)."""
    between = pose.inverse() @ other
    return jnp.concatenate([between.rotation().log(), between.translation()])


def way(problem: Problem) -> Float[Array, " m"]:
    """Return the length that each link counts for the drift, m."""
    steps = jnp.linalg.norm(jnp.diff(problem.odometry[:, 4:], axis=0), axis=1)
    return steps + STILL_SPEED * jnp.diff(problem.time)


class Roots(eqx.Module):
    """Square roots of the information of each residual."""

    link: Float[Array, "m 21 21"]
    """Of the inertial link (15) and of the odometry's relative pose (6)."""
    white: Float[Array, "6"]
    """Of the odometry's white error."""
    first: Float[Array, "15"]
    common: Float[Array, "18"]
    fix: Float[Array, "g 3"]

    def log_determinant(self) -> Array:
        """Return the sum of the logarithms of all roots of noise; the priors do not count."""
        links = jnp.sum(jnp.log(jnp.diagonal(self.link, axis1=1, axis2=2)))
        white = (len(self.link) + 1) * jnp.sum(jnp.log(self.white))
        return links + white + jnp.sum(jnp.log(self.fix))


def roots_of(problem: Problem, params: FusionParams) -> Roots:
    """Return the roots of the information of all residuals, for given noise."""
    dtype = problem.time.dtype
    noise, mounting, initial = params.odometry, params.extrinsics, params.initial
    covariance = problem.covariance.of(params.imu)
    scale = 1 / jnp.sqrt(jnp.diagonal(covariance, axis1=1, axis2=2))
    lower = jax.lax.linalg.cholesky(scale[:, :, None] * covariance * scale[:, None, :])
    identity = jnp.broadcast_to(jnp.eye(15, dtype=dtype), lower.shape)
    inertial = jax.lax.linalg.triangular_solve(lower, identity, left_side=True, lower=True)
    inertial = inertial * scale[:, None, :]
    along = 1 / jnp.sqrt(way(problem))
    drift = jnp.repeat(1 / jnp.stack([noise.rotation_drift, noise.translation_drift]), 3)
    link = jnp.zeros((len(along), NODE_DOF, NODE_DOF), dtype)
    link = link.at[:, :15, :15].set(inertial)
    link = link.at[:, 15:, 15:].set(along[:, None, None] * jnp.diag(drift))

    def exact(*sigmas: Array) -> Array:
        return 1 / jnp.maximum(jnp.concatenate([jnp.atleast_1d(sigma) for sigma in sigmas]), _EXACT)

    def three(value: Array) -> Array:
        return jnp.full(3, value)

    fixed = len(problem.fixes.link) > 0
    yaw, origin = (_WIDE_TURN, _WIDE_ORIGIN) if fixed else (_LEVEL_YAW, _LEVEL_ORIGIN)
    return Roots(
        link=link,
        white=jnp.repeat(1 / jnp.stack([noise.rotation_noise, noise.translation_noise]), 3),
        first=exact(
            jnp.asarray(_FIRST_POSE, dtype),
            three(initial.velocity_sigma),
            three(initial.gyro_bias_sigma),
            three(initial.accel_bias_sigma),
        ),
        common=exact(
            three(mounting.rotation_sigma),
            three(mounting.translation_sigma),
            noise.scale_sigma,
            three(noise.turn_sigma),
            jnp.asarray((_WIDE_TURN, _WIDE_TURN, yaw), dtype),
            jnp.full(3, origin, dtype),
            noise.time_offset_sigma,
            params.gps.time_offset_sigma,
        ),
        fix=1 / (params.gps.sigma_scale * problem.fixes.sigma),
    )


def gravity_in_world(packed: Float[Array, "20"], gravity: Float[Array, ""]) -> Float[Array, "3"]:
    """Return the acceleration of gravity in the odometry's world, m/s^2."""
    level = common_of(packed).T_level_world.rotation()
    return level.inverse() @ (-gravity * jnp.eye(3, dtype=packed.dtype)[2])


def gravity_by_level(
    end: Float[Array, "22"], packed: Float[Array, "20"], duration: Float[Array, ""], gravity: Array
) -> Float[Array, "15 3"]:
    """Return the derivative of an inertial residual by the rotation of T_level_world, level axes."""
    level = rotation_matrix(common_of(packed).T_level_world.rotation())
    down = -gravity * jnp.eye(3, dtype=packed.dtype)[2]
    turned = rotation_matrix(motion_of(end).T_world_imu.rotation()).T @ level.T @ skew(down)
    none = jnp.zeros((3, 3), packed.dtype)
    return jnp.concatenate([none, duration**2 / 2 * turned, duration * turned, none, none])


def odometry_residual(start: Array, end: Array, packed: Array, row: tuple) -> Float[Array, "6"]:
    """Return the true relative pose in the frame of the measured one, not whitened: rad, then m."""
    common = common_of(packed)
    first, second, first_gyro, second_gyro = row

    def corrected(pose: Array, node: Array) -> jaxlie.SE3:
        error = node[16:]
        shift = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.exp(error[:3]), error[3:])
        return jaxlie.SE3(pose) @ shift

    step = corrected(first, start).inverse() @ corrected(second, end)
    length = jnp.linalg.norm(second[4:] - first[4:] + 1e-12)
    turned = step.rotation() @ jaxlie.SO3.exp(-common.turn * length)
    moved = step.translation() * jnp.exp(-common.log_scale)
    measured = jaxlie.SE3.from_rotation_and_translation(turned, moved)
    true = _sensor_pose(start, first_gyro, common).inverse() @ _sensor_pose(end, second_gyro, common)
    return _difference(measured, true)


def first_residual(node: Array, packed: Array, problem: Problem) -> Float[Array, "15"]:
    """Return the first state's difference from its prior, not whitened."""
    state, common = motion_of(node), common_of(packed)
    pose = _difference(jaxlie.SE3(problem.odometry[0]), state.T_world_imu @ common.T_imu_sensor)
    return jnp.concatenate([pose, state.velocity, state.gyro_bias, state.accel_bias])


def common_residual(packed: Array, problem: Problem) -> Float[Array, "18"]:
    """Return the common unknowns' difference from their prior, not whitened."""
    common, guess = common_of(packed), jaxlie.SE3(problem.level)
    mounting = jaxlie.SE3(problem.mounting)
    turned = (mounting.rotation().inverse() @ common.T_imu_sensor.rotation()).log()
    level = (common.T_level_world.rotation() @ guess.rotation().inverse()).log()
    return jnp.concatenate(
        [
            turned,
            common.T_imu_sensor.translation() - mounting.translation(),
            common.log_scale[None],
            common.turn,
            level,
            common.T_level_world.translation() - guess.translation(),
            common.time_offset[None],
            common.fix_offset[None],
        ]
    )


def fix_residual(start: Array, end: Array, packed: Array, row: tuple, lever_arm: Array) -> Float[Array, "3"]:
    """Return the antenna's position in the level frame minus a fix, m.

    Between two states the position is the cubic through both positions and velocities.
    """
    share, elapsed, position = row
    first, second, common = motion_of(start), motion_of(end), common_of(packed)
    u, h = share, elapsed
    weights = (2 * u**3 - 3 * u**2 + 1, h * (u**3 - 2 * u**2 + u), 3 * u**2 - 2 * u**3, h * (u**3 - u**2))
    knots = (
        first.T_world_imu.translation(),
        first.velocity,
        second.T_world_imu.translation(),
        second.velocity,
    )
    centre = sum((weight * knot for weight, knot in zip(weights, knots, strict=True)), jnp.zeros(3))
    centre = centre + common.fix_offset * ((1 - u) * first.velocity + u * second.velocity)
    turn = (first.T_world_imu.rotation().inverse() @ second.T_world_imu.rotation()).log()
    rotation = first.T_world_imu.rotation() @ jaxlie.SO3.exp(u * turn)
    return common.T_level_world @ (centre + rotation @ lever_arm) - position
