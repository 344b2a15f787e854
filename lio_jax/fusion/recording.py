"""Fuse a recording's odometry with its inertial samples and fixes, on the host."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.geometry import adjoint_of
from lio_jax.core.leaf import traced
from lio_jax.core.types import CONVERGED, NOT_FINITE
from lio_jax.data.sequence import GpsData, ImuData
from lio_jax.data.trajectory import Trajectory
from lio_jax.fusion.params import FusionParams
from lio_jax.fusion.prepare import prepare_fusion, within
from lio_jax.fusion.problem import FusedStates, Problem
from lio_jax.fusion.solve import Fused, fuse

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class FusedRecording:
    """The fused trajectory and what was found with it."""

    sensor: Trajectory
    """Poses T_world_sensor of the odometry's sensor; the world is that of the odometry."""
    imu: Trajectory
    """Poses T_world_imu in the same world."""
    covariance: _Array
    """(n, 6, 6) covariance of T_world_sensor's right perturbation: rotation (rad), position (m)."""
    velocity: _Array
    """(n, 3) velocity of the IMU, m/s, in world."""
    gyro_bias: _Array
    """(n, 3) rad/s."""
    accel_bias: _Array
    """(n, 3) m/s^2."""
    gravity: _Array
    """(3,) acceleration of gravity, m/s^2, in world."""
    T_imu_sensor: _Array
    """(4, 4) pose of the odometry's sensor in the IMU frame."""
    T_level_world: _Array
    """(4, 4) pose of the world in the frame of the fixes; without fixes only its roll and pitch are known."""
    scale: float
    """Length by the odometry over the true length."""
    time_offset: float
    """What has to be added to the odometry's stamps, s."""
    fix_offset: float
    """What has to be added to the fixes' stamps, s."""
    fused: Fused
    """The result in arrays."""
    problem: Problem
    """The measurements."""

    @property
    def converged(self) -> bool:
        """Return whether the iterations ended at a minimum."""
        return int(self.fused.status) == CONVERGED


def fuse_recording(
    odometry: Trajectory, imu: ImuData, gps: GpsData | None = None, params: FusionParams | None = None
) -> FusedRecording:
    """Fuse poses of any odometry with inertial samples and GPS fixes.

    Args:
        odometry: poses of the odometry's sensor in its world.
        imu: samples with ascending stamps in the same clock.
        gps: fixes in a local level frame; None: there are none.
        params: noise, priors and calibration; None: the defaults.

    Raises:
        LioJaxError: times do not overlap, or the numbers have no finite solution.
    """
    params = traced(FusionParams) if params is None else params
    problem, states = prepare_fusion(odometry, imu, gps, params)
    return solved(within(odometry, imu), problem, states, params)


def solved(
    odometry: Trajectory, problem: Problem, states: FusedStates, params: FusionParams
) -> FusedRecording:
    """Return the fusion of a prepared problem.

    Args:
        odometry: the poses that the problem uses.
        problem: the measurements.
        states: first guess.
        params: noise, priors and calibration.

    Raises:
        LioJaxError: the numbers have no finite solution.
    """
    fused = fuse(problem, params, states)
    if int(fused.status) == NOT_FINITE or not np.isfinite(float(fused.cost)):
        raise LioJaxError(
            "the fusion of odometry and inertial samples has no finite solution; check the units of the "
            "samples (rad/s, m/s^2), the clocks, and the noise in params.*."
        )
    motion = fused.states.motion_states()
    common = fused.states.unpacked()
    poses = np.asarray(motion.T_world_imu.as_matrix(), np.float64)
    mounting = np.asarray(common.T_imu_sensor.as_matrix(), np.float64)
    level = np.asarray(common.T_level_world.as_matrix(), np.float64)
    imu = Trajectory(odometry.stamp_ns, poses)
    gravity = level[:3, :3].T @ np.array([0.0, 0.0, -float(params.imu.gravity)])
    return FusedRecording(
        sensor=imu.times_body(mounting),
        imu=imu,
        covariance=_of_sensor(fused, mounting),
        velocity=np.asarray(motion.velocity),
        gyro_bias=np.asarray(motion.gyro_bias),
        accel_bias=np.asarray(motion.accel_bias),
        gravity=gravity,
        T_imu_sensor=mounting,
        T_level_world=level,
        scale=float(jnp.exp(common.log_scale)),
        time_offset=float(common.time_offset),
        fix_offset=float(common.fix_offset),
        fused=fused,
        problem=problem,
    )


def _of_sensor(fused: Fused, T_imu_sensor: _Array) -> _Array:
    """Return the (n, 6, 6) covariances of the sensor's poses.

    With T_world_sensor = T_world_imu T_imu_sensor its right perturbation is Ad(T_imu_sensor^-1) times that of
    the IMU's pose, plus that of T_imu_sensor.
    """
    by_imu = adjoint_of(np.asarray(np.linalg.inv(T_imu_sensor), np.float64))
    by_mounting = np.eye(6)
    by_mounting[3:, 3:] = T_imu_sensor[:3, :3].T
    own, cross = np.asarray(fused.covariance)[:, :6, :6], np.asarray(fused.cross_covariance)[:, :6, :6]
    both = by_imu @ cross @ by_mounting.T
    shared = by_mounting @ np.asarray(fused.common_covariance)[:6, :6] @ by_mounting.T
    return np.asarray(by_imu @ own @ by_imu.T + both + both.transpose(0, 2, 1) + shared, np.float64)
