"""Deskewing of real handheld sweeps against another system's result.

The reference's frame: each of its points is that of the raw sweep, in the same order, moved into the **IMU**
frame at the **start** of the sweep, q = T_start_now T_imu_lidar p. T_imu_lidar is half a turn about z and a
few cm; the earliest points agree by it alone, the latest are metres off. Ours come out in the **lidar** frame
at the sweep's **end**, so that T_start_end T_imu_lidar takes them to the reference's.

The motion that the reference used is not recorded (the IMU samples beside it are of another walk). It is
therefore found from a few hundred points as the inertial samples that explain them, and judged by all others:
a wrong frame, order of transforms or direction of time could not be explained by any motion.
"""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from jaxtyping import Array, Float

from lio_jax.core.types import ImuBatch, initial_nav_state
from lio_jax.imu.path import Path, carry, deskew_along
from lio_jax.imu.strapdown import path_along
from tests.shared_data import SHARED_DATA, needs_shared

SAMPLES = 9
"""Number of samples of an IMU at 80 Hz in a sweep of 0.1 s."""
FITTED = 800
SIZE = 32768
"""All sweeps padded to it share one program."""
T_IMU_LIDAR = jaxlie.SE3(jnp.array([0.0, 0.0, 0.0, 1.0, -0.006, 0.012, -0.029]))

pytestmark = needs_shared


def sweep(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return raw points, their times and the reference's points."""
    folder = SHARED_DATA / "newer_college"
    points, reference = (
        np.fromfile(folder / f"{name}_{number:02d}.bin", np.float32).reshape(-1, 3)
        for name in ("raw", "deskewed")
    )
    return points, np.fromfile(folder / f"times_{number:02d}.bin", np.float32), reference


def path_by(unknown: Float[Array, " u"], end: Float[Array, ""]) -> Path:
    """Return the motion from the IMU frame at the sweep's start, from first velocity and inertial samples."""
    velocity, samples = unknown[:3], unknown[3:].reshape(2, SAMPLES, 3)
    start = initial_nav_state(T_IMU_LIDAR)
    # whatever gravity is, the fitted specific force holds it
    nav = dataclasses.replace(start, velocity=velocity, gravity=jnp.zeros(3))
    times = jnp.linspace(0.0, end, SAMPLES)
    imu = ImuBatch(time=times, gyro=samples[0], accel=samples[1], mask=jnp.ones(SAMPLES, bool))
    return path_along(nav, imu, jnp.zeros(()), end)


def residual(
    unknown: Float[Array, " u"],
    points: Float[Array, "n 3"],
    times: Float[Array, " n"],
    reference: Float[Array, "n 3"],
    end: Float[Array, ""],
) -> Float[Array, " m"]:
    moved = carry(path_by(unknown, end), times, jax.vmap(T_IMU_LIDAR.apply)(points))
    return (moved - reference).ravel()


@cache
def deskewed(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return our points in the lidar frame at the end, T_start_end, the reference, and what to judge."""
    points, times, reference = sweep(number)
    fitted = np.linspace(0, len(points) - 1, FITTED).astype(int)
    end = jnp.asarray(float(times.max()))
    data = [jnp.asarray(array[fitted], float) for array in (points, times, reference)]
    unknown = jnp.zeros(3 + 6 * SAMPLES)
    for _ in range(8):
        r = residual_of(unknown, *data, end)
        # Huber's weights at 5 cm
        weight = 1 / jnp.maximum(1.0, jnp.abs(r) / 0.05)
        jacobian = jacobian_of(unknown, *data, end)
        unknown = unknown - jnp.linalg.lstsq(jacobian * weight[:, None], r * weight)[0]
    path = path_of(unknown, end)
    spare = SIZE - len(points)
    ours = deskew_of(path, T_IMU_LIDAR, np.pad(points, ((0, spare), (0, 0))), np.pad(times, (0, spare)))
    others = np.ones(len(points), bool)
    others[fitted] = False
    last = jaxlie.SE3(path.T_world_imu.wxyz_xyz[-1])
    return np.asarray(ours, float)[: len(points)], np.asarray(last.as_matrix()), reference, others


residual_of = jax.jit(residual)
jacobian_of = jax.jit(jax.jacfwd(residual))
path_of = jax.jit(path_by)
deskew_of = jax.jit(deskew_along)


def placed(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


@pytest.mark.parametrize("number", [0, 1, 2])
def test_deskewing_agrees_with_the_reference(number: int) -> None:
    ours, T_start_end, reference, others = deskewed(number)
    in_reference = placed(ours, T_start_end @ np.asarray(T_IMU_LIDAR.as_matrix()))
    off = np.linalg.norm(in_reference - reference, axis=1)[others]
    assert len(off) > 19_000
    # measured: 0.004, 0.005 and 0.020 m
    assert off.mean() < 0.03


@pytest.mark.parametrize("number", [0, 1, 2])
def test_without_deskewing_it_does_not(number: int) -> None:
    points, _, reference = sweep(number)
    off = np.linalg.norm(placed(points, np.asarray(T_IMU_LIDAR.as_matrix())) - reference, axis=1)
    assert off.mean() > 0.5


def test_the_frame_is_that_of_the_start() -> None:
    """Read as of the sweep's end the same points are decimetres off."""
    ours, _, reference, others = deskewed(0)
    at_end = placed(ours, np.asarray(T_IMU_LIDAR.as_matrix()))
    assert np.linalg.norm(at_end - reference, axis=1)[others].mean() > 0.3
