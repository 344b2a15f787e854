"""A recipe with a learned part: how sure the ranges are while the sensor turns and shakes.

A network of one hidden layer turns the motion during a sweep into a factor of the range noise, which the
match of the default recipe then uses (as Brossard, Barrau & Bonnabel, "AI-IMU dead-reckoning", 2020, do with
the noise of a wheel's motion). Its weights are parameters like any other: they are trained without truth, by
the likelihood of the innovations.

lio-jax train A.bag B.bag --recipe experiments/learned_noise.py:LearnedNoise --params learned.weights \\
    --objective pose --validate C.bag --out out/trained
lio-jax run D.bag --recipe out/trained/trained.yaml --out out/d
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lio_jax import ImuBatch, leaf, section
from lio_jax.recipes.default import Default
from lio_jax.recipes.default_params import DefaultParams

HIDDEN = 6
_START = np.random.default_rng(0).normal(0.0, 0.5, 4 * HIDDEN + 1)
_START[3 * HIDDEN :] = 0.0
"""Random weights of the first layer; the second one gives the factor 1 at the start."""


class Learned(eqx.Module):
    """Weights of the network."""

    weights: Float[Array, "25"] = leaf(tuple(_START.round(4).tolist()), tuned="linear")
    """Weights of two layers, flat: (2, 6) and (6) of the first, (6) and 1 of the second."""


class Params(DefaultParams):
    """The default recipe's parameters and the network's."""

    learned: Learned = section(Learned)


class LearnedNoise(Default):
    """The default recipe with a range noise that follows the motion."""

    params_type = Params

    def step(self, params, state, scan, imu=None):
        if imu is not None:
            factor = jnp.exp(network(params.learned.weights, motion(imu)))
            sigma = params.lidar.range_sigma * factor
            params = eqx.tree_at(lambda one: one.lidar.range_sigma, params, sigma)
        return super().step(params, state, scan, imu)


def motion(imu: ImuBatch) -> Float[Array, "2"]:
    """Return the root mean square of rate (rad/s) and of the change of specific force (m/s^2) in a sweep."""
    count = jnp.maximum(jnp.sum(imu.mask), 1)
    mean = jnp.sum(jnp.where(imu.mask[:, None], imu.accel, 0.0), 0) / count
    squares = jnp.stack([jnp.sum(imu.gyro**2, -1), jnp.sum((imu.accel - mean) ** 2, -1)])
    # far from zero, where the root has no derivative
    return jnp.sqrt(jnp.sum(jnp.where(imu.mask, squares, 0.0), -1) / count + 1e-6)


def network(weights: Float[Array, "25"], inputs: Float[Array, "2"]) -> Float[Array, ""]:
    """Return the output of a network with one hidden layer."""
    first, bias, second = (
        weights[: 2 * HIDDEN].reshape(HIDDEN, 2),
        weights[2 * HIDDEN : 3 * HIDDEN],
        weights[3 * HIDDEN : -1],
    )
    return second @ jnp.tanh(first @ inputs + bias) + weights[-1]
