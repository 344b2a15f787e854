"""A first guess of a fusion's unknowns from the motion that odometry and inertial samples share."""

import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.types import state_dtype
from lio_jax.fusion.params import FusionParams
from lio_jax.fusion.problem import Fixes, FusedStates, Problem, UnitCovariances
from lio_jax.imu.preintegration import Preintegrated

_Array = NDArray[np.float64]

_WINDOW_S = 1.0
"""Length of the windows over which velocities are compared, s."""
_RATE_ERROR, _SPEED_ERROR, _PRIOR_ERROR = 0.02, 0.2, 1.0
"""Standard deviations of a link's mean angular rate, rad/s, of a window's gain of velocity, m/s, and of the
entries of the rotation matrix about their prior."""


def first_guess(
    poses: _Array,
    time: _Array,
    gyro: _Array,
    links: Preintegrated,
    covariance: UnitCovariances,
    fixes: Fixes,
    params: FusionParams,
) -> tuple[Problem, FusedStates]:
    """Return the measurements with their priors, and the unknowns at which iterations begin.

    The rotation between the sensors and the direction of gravity solve one linear system: angular rates agree
    in both frames, and so do gains of velocity apart from gravity. A drive on a plane turns about one axis
    only; there the gains of velocity tell the rest of the rotation.

    Args:
        poses: (n, 4, 4) of the odometry's sensor in its world.
        time: (n,) s.
        gyro: (n, 3) angular rates at the poses, rad/s, IMU frame.
        links: n - 1 preintegrated links, without biases.
        covariance: of the links.
        fixes: GPS fixes in the level frame.
        params: calibration and noise.
    """
    mounting = np.eye(4)
    mounting[:3, :3] = Rotation.from_quat(np.asarray(params.extrinsics.rotation)).as_matrix()
    mounting[:3, 3] = np.asarray(params.extrinsics.translation)
    given = float(params.extrinsics.rotation_sigma) < 0.1
    rotation, down = _rotation_and_gravity(poses, time, links, mounting[:3, :3], given)
    mounting[:3, :3] = rotation
    imu = poses @ np.linalg.inv(mounting)
    velocity = np.gradient(imu[:, :3, 3], time, axis=0)
    level = np.eye(4)
    level[:3, :3] = _levelling(down)
    antenna = imu[:, :3, :3] @ np.asarray(params.gps.lever_arm) + imu[:, :3, 3]
    if len(fixes.link):
        level = _aligned(level, antenna, fixes) @ level
    dtype = state_dtype()
    problem = Problem(
        odometry=jnp.asarray(_packed(poses), dtype),
        time=jnp.asarray(time, dtype),
        gyro=jnp.asarray(gyro, dtype),
        imu=links,
        covariance=covariance,
        level=jnp.asarray(_packed(level[None])[0], dtype),
        mounting=jnp.asarray(_packed(mounting[None])[0], dtype),
        fixes=fixes,
    )
    nothing = np.zeros((len(time), 12))
    motion = np.concatenate([_packed(imu), velocity, nothing], axis=1)
    common = np.concatenate([_packed(mounting[None])[0], np.zeros(4), _packed(level[None])[0], np.zeros(2)])
    return problem, FusedStates(jnp.asarray(motion, dtype), jnp.asarray(common, dtype))


def _packed(poses: _Array) -> _Array:
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    return np.concatenate([quaternion, poses[:, :3, 3]], axis=1)


def _rotation_and_gravity(
    poses: _Array, time: _Array, links: Preintegrated, prior: _Array, given: bool
) -> tuple[_Array, _Array]:
    """Return the rotation of T_imu_sensor, and gravity in the odometry's world, m/s^2."""
    elapsed = np.diff(time)
    measured = np.asarray(links.measured) & (elapsed < 2 * _WINDOW_S)
    turned = np.asarray(jaxlie.SO3(links.rotation.wxyz).log()) / elapsed[:, None]
    between = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    seen = Rotation.from_matrix(between).as_rotvec() / elapsed[:, None]
    rows, values = [], []
    # unknown: the rows of R_sensor_imu, then gravity
    for one, other in zip(turned[measured], seen[measured], strict=True):
        rows.append(np.hstack([np.kron(np.eye(3), one), np.zeros((3, 3))]) / _RATE_ERROR)
        values.append(other / _RATE_ERROR)
    stride = max(1, round(_WINDOW_S / float(np.median(elapsed))))
    velocity = np.asarray(links.velocity)
    for first in range(0, len(elapsed) - 2 * stride, stride):
        # mean velocities over two windows differ by what is gained between their links' middles
        window = slice(first, first + 2 * stride)
        if not measured[window].all():
            continue
        middle, end = first + stride, first + 2 * stride
        before = (poses[middle, :3, 3] - poses[first, :3, 3]) / (time[middle] - time[first])
        after = (poses[end, :3, 3] - poses[middle, :3, 3]) / (time[end] - time[middle])
        blocks, duration = np.zeros((3, 9)), 0.0
        for k in range(first, end):
            centre = (time[k] + time[k + 1]) / 2
            into = np.clip((centre - time[first]) / (time[middle] - time[first]), 0, 1)
            out = np.clip((time[end] - centre) / (time[end] - time[middle]), 0, 1)
            share = into if centre < time[middle] else out
            blocks += share * np.kron(poses[k, :3, :3], velocity[k][None])
            duration += share * elapsed[k]
        rows.append(np.hstack([blocks, duration * np.eye(3)]) / _SPEED_ERROR)
        values.append((after - before) / _SPEED_ERROR)
    sigma = 1e-6 if given else _PRIOR_ERROR
    rows.append(np.hstack([np.eye(9), np.zeros((9, 3))]) / sigma)
    values.append(prior.T.reshape(-1) / sigma)
    found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    left, _, right = np.linalg.svd(found[:9].reshape(3, 3))
    R_sensor_imu = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return (prior if given else R_sensor_imu.T), found[9:]


def _levelling(down: _Array) -> _Array:
    """Return a rotation that turns gravity to -z."""
    length = np.linalg.norm(down)
    if not length > 0:
        return np.eye(3)
    return Rotation.align_vectors([[0.0, 0.0, -1.0]], [down / length])[0].as_matrix()


def _aligned(level: _Array, antenna: _Array, fixes: Fixes) -> _Array:
    """Return the yaw and the translation from the levelled world to the frame of the fixes, (4, 4)."""
    link, share = np.asarray(fixes.link), np.asarray(fixes.share)[:, None]
    there = (1 - share) * antenna[link] + share * antenna[link + 1]
    there = there @ level[:3, :3].T
    fixed = np.asarray(fixes.position)
    a, b = there - there.mean(0), fixed - fixed.mean(0)
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, :2] * b[:, :2]))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    pose[:3, 3] = fixed.mean(0) - pose[:3, :3] @ there.mean(0)
    return pose
