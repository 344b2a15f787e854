"""Preintegrate inertial samples between two instants, and predict the second state from the first."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie

from lio_jax import ImuBatch, Settings, initial_nav_state, predict, preintegrate, sample_intervals

jax.config.update("jax_enable_x64", True)

# one second of a circle: 2 m/s ahead, 0.5 rad/s to the left, 100 Hz
time = jnp.arange(101) * 0.01
gyro, accel = jnp.tile(jnp.array([0, 0, 0.5]), (101, 1)), jnp.tile(jnp.array([0, 1.0, 9.80665]), (101, 1))
samples = ImuBatch(time, gyro, accel, mask=jnp.ones(101, bool))

intervals = sample_intervals(samples, time_offset=jnp.array(0.0), start=time[0], end=time[-1])
motion = preintegrate(intervals, jnp.zeros(3), jnp.zeros(3), Settings().params().imu)
start = eqx.tree_at(
    lambda nav: nav.velocity, initial_nav_state(jaxlie.SE3.identity()), jnp.array([2.0, 0, 0])
)
end = predict(motion, start)
sigma = jnp.sqrt(jnp.diag(motion.covariance))[3:6]
print(f"position {end.T_world_imu.translation().round(4)} m, sigma {sigma.round(4)} m")
print(f"velocity {end.velocity.round(4)} m/s")
