"""Random navigation states, for the tests of the estimator."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from lio_jax.core.error_state import DOF
from lio_jax.core.types import NavState


@jax.jit
def random_nav(seed: int) -> NavState:
    keys = jax.random.split(jax.random.key(seed), 7)
    return NavState(
        T_world_imu=jaxlie.SE3.sample_uniform(keys[0]),
        velocity=jax.random.normal(keys[1], (3,)),
        gyro_bias=jax.random.normal(keys[2], (3,)),
        accel_bias=jax.random.normal(keys[3], (3,)),
        gravity=jaxlie.SO3.exp(0.3 * jax.random.normal(keys[4], (3,))) @ jnp.array([0, 0, -9.81]),
        T_imu_lidar=jaxlie.SE3.sample_uniform(keys[5]),
        time_offset=jax.random.normal(keys[6], ()),
    )


def random_covariance(seed: int, scale: float = 0.1) -> jax.Array:
    root = scale * np.random.default_rng(seed).normal(size=(DOF, DOF)) / DOF**0.5
    return jnp.asarray(root @ root.T)
