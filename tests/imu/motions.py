"""Analytic motions: exact poses, rates and forces at any time."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

GRAVITY = jnp.array([0.0, 0.0, -9.80665])

Pose = Callable[[jax.Array], jaxlie.SE3]


def straight(t: jax.Array) -> jaxlie.SE3:
    """Drive straight on, from 5 m/s, accelerating by 1 m/s^2."""
    return jaxlie.SE3.from_translation(jnp.stack([5.0 * t + 0.5 * t**2, 0 * t, 0 * t]))


def turning_car(t: jax.Array) -> jaxlie.SE3:
    """Turn left at 10 m/s on a circle of 25 m, rolled outwards, with a little sway."""
    yaw = 0.4 * t
    position = jnp.stack([25 * jnp.sin(yaw), 25 * (1 - jnp.cos(yaw)), 0.05 * jnp.sin(7 * t)])
    rotation = jaxlie.SO3.from_rpy_radians(
        0.06 + 0.02 * jnp.sin(5 * t), 0.03 + 0.02 * jnp.sin(6 * t + 1), yaw
    )
    return jaxlie.SE3.from_rotation_and_translation(rotation, position)


def handheld(t: jax.Array) -> jaxlie.SE3:
    """Walk at 1.3 m/s swinging the sensor by up to 1.5 rad/s."""
    position = jnp.stack([1.3 * t + 0.1 * jnp.sin(5 * t), 0.2 * jnp.sin(3 * t), 0.05 * jnp.sin(11 * t)])
    rotation = jaxlie.SO3.from_rpy_radians(
        0.4 + 0.25 * jnp.sin(4 * t), -0.2 + 0.2 * jnp.sin(5 * t + 1), 0.5 * jnp.sin(3 * t)
    )
    return jaxlie.SE3.from_rotation_and_translation(rotation, position)


@dataclass(frozen=True)
class Truth:
    """A motion at given times."""

    pose: jaxlie.SE3
    velocity: np.ndarray
    """Velocity, world frame, m/s."""
    rate: np.ndarray
    """Angular rate, body frame, rad/s."""
    force: np.ndarray
    """Specific force in the body, m/s^2."""


@cache
def truth_at(motion: Pose, first: int, count: int, rate: float) -> Truth:
    """Return the motion at ``count`` times, the number ``first`` of a grid of ``rate`` Hz at their head.

    Its derivatives are those of automatic differentiation.
    """

    def one(t: jax.Array) -> tuple[jaxlie.SE3, jax.Array, jax.Array, jax.Array]:
        pose = motion(t)
        velocity = jax.jacfwd(lambda s: motion(s).translation())
        acceleration = jax.jacfwd(velocity)(t)
        turning = jax.jacfwd(lambda s: motion(s).rotation().as_matrix())(t)
        cross = pose.rotation().as_matrix().T @ turning
        turned = jnp.stack([cross[2, 1], cross[0, 2], cross[1, 0]])
        return pose, velocity(t), turned, pose.rotation().inverse() @ (acceleration - GRAVITY)

    pose, velocity, turned, force = jax.jit(jax.vmap(one))((first + jnp.arange(count)) / rate)
    return Truth(pose, np.asarray(velocity), np.asarray(turned), np.asarray(force))
