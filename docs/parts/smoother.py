"""Smooth noisy poses with the inertial samples between them, over a whole recording."""

import jax
import jax.numpy as jnp
import jaxlie

from lio_jax import (
    Chain,
    ImuBatch,
    MotionState,
    PoseMeasurement,
    Settings,
    gaussian_prior,
    preintegrate,
    sample_intervals,
    smooth,
)

jax.config.update("jax_enable_x64", True)

# a circle of 20 s: 2 m/s ahead, 0.5 rad/s to the left; a pose each second with errors of 5 cm and 5 mrad
time, knots = jnp.arange(2101) * 0.01, jnp.arange(21.0)
gyro, accel = jnp.tile(jnp.array([0, 0, 0.5]), (2101, 1)), jnp.tile(jnp.array([0, 1.0, 9.80665]), (2101, 1))
samples = ImuBatch(time, gyro, accel, mask=jnp.ones(2101, bool))
place = jnp.stack([4 * jnp.sin(knots / 2), 4 * (1 - jnp.cos(knots / 2)), 0 * knots], axis=1)
true = jaxlie.SE3.from_rotation_and_translation(jax.vmap(jaxlie.SO3.from_z_radians)(knots / 2), place)
sigma = jnp.repeat(jnp.array([0.05, 0.005]), 3)  # translation first, as in jaxlie
measured = true @ jaxlie.SE3.exp(sigma * jax.random.normal(jax.random.key(0), (21, 6)))


def between(start):
    intervals = sample_intervals(samples, jnp.array(0.0), start, start + 1.0)
    return preintegrate(intervals, jnp.zeros(3), jnp.zeros(3), Settings().params().imu)


weight = jnp.diag(1 / jnp.roll(sigma, 3) ** 2)  # rotation first, as everywhere in lio_jax
lidar = PoseMeasurement(measured, jnp.tile(weight, (21, 1, 1)), jnp.full(21, 1e3), jnp.ones(21, bool))
guess = MotionState(measured, *jnp.zeros((3, 21, 3)))
spread = jnp.repeat(jnp.array([1.0, 10.0, 10.0, 0.01, 0.1]), 3)  # rad, m, m/s, rad/s, m/s^2
prior = gaussian_prior(jax.tree.map(lambda rows: rows[0], guess), jnp.diag(spread**2))
chain = Chain(jnp.int32(21), jnp.array([0, 0, -9.80665]), prior, jax.vmap(between)(knots), lidar)
result = jax.jit(smooth)(chain, guess, max_iterations=jnp.int32(30), tolerance=jnp.array(1e-6))

for name, poses in (("measured", measured), ("smoothed", result.states.T_world_imu)):
    print(f"{name}: mean error {jnp.linalg.norm(poses.translation() - place, axis=1).mean():.3f} m")
print(f"sigma of the eleventh position {jnp.sqrt(jnp.diagonal(result.covariances()[10]))[3:6].round(4)} m")
