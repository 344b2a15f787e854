"""Express the points of a sweep in the frame of its last instant."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie

from lio_jax import ImuBatch, deskew_along, initial_nav_state, path_along

jax.config.update("jax_enable_x64", True)

# a sweep of 0.1 s at 10 m/s ahead and 1 rad/s to the left, seen by a lidar in the IMU's place
time = jnp.arange(11) * 0.01
gyro, accel = jnp.tile(jnp.array([0, 0, 1.0]), (11, 1)), jnp.tile(jnp.array([0, 10.0, 9.80665]), (11, 1))
samples = ImuBatch(time, gyro, accel, mask=jnp.ones(11, bool))
start = eqx.tree_at(
    lambda nav: nav.velocity, initial_nav_state(jaxlie.SE3.identity()), jnp.array([10.0, 0, 0])
)
path = path_along(start, samples, start=time[0], end=time[-1])

# one post, fired at 1,000 times: where the lidar saw it, and the same points at the end of the sweep
fired = jnp.linspace(0.0, 0.1, 1000)
turn = jax.vmap(jaxlie.SO3.from_z_radians)(fired)
place = jnp.stack([10 * jnp.sin(fired), 10 * (1 - jnp.cos(fired)), 0 * fired], axis=1)
seen = turn.inverse() @ (jnp.array([20.0, 5.0, 1.0]) - place)
compensated = deskew_along(path, start.T_imu_lidar, seen, fired)
for name, cloud in (("as seen", seen), ("compensated", compensated)):
    print(f"{name}: the post is spread over {jnp.ptp(cloud, axis=0).round(3)} m")
