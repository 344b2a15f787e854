"""Objectives against ground truth, from running sums: absolute and relative trajectory error."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.types import state_dtype
from lio_jax.tuning.objective import Observed, TruePose


class AbsoluteError(eqx.Module):
    """Root mean square position error after the best rigid alignment, m.

    Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987; Umeyama 1991, from the
    moments of the two point sets alone. At the best rotation the error's derivative by the rotation vanishes,
    so the alignment is differentiable without differentiating the decomposition.
    """

    def start(self) -> Float[Array, "18"]:
        """Return count, sums, products and squares."""
        return jnp.zeros(18, state_dtype())

    def add(self, sums: Float[Array, "18"], seen: Observed, truth: TruePose) -> Float[Array, "18"]:
        """Add a pair of positions, where the truth is known."""
        p, q = seen.nav.T_world_imu.translation(), truth.T_world_imu.translation()
        products = (q[:, None] * p).ravel()
        moments = jnp.concatenate([jnp.ones(1), p, q, products, (p @ p)[None], (q @ q)[None]])
        return sums + jnp.where(truth.known, moments, 0.0)

    def value(self, sums: Float[Array, "18"]) -> Float[Array, ""]:
        """Return the error; 0 for fewer than two poses."""
        count = jnp.maximum(sums[0], 1.0)
        p, q = sums[1:4] / count, sums[4:7] / count
        covariance = sums[7:16].reshape(3, 3) / count - q[:, None] * p
        left, _, right = jnp.linalg.svd(jax.lax.stop_gradient(covariance))
        flip = jnp.diag(jnp.ones(3).at[2].set(jnp.sign(jnp.linalg.det(left @ right))))
        aligned = jnp.sum((left @ flip @ right) * covariance)
        mean_square = sums[16] / count - p @ p + sums[17] / count - q @ q - 2 * aligned
        return _root(mean_square)


class RelativeError(eqx.Module):
    """Root mean square error of the motion over a number of scans: m, or rad for the rotation."""

    scans: int = eqx.field(static=True, default=10)
    rotation: bool = eqx.field(static=True, default=False)

    def start(self) -> tuple[Any, ...]:
        """Return the last poses of both and whether they are known, the sum of squares and the count."""
        poses = jnp.zeros((2, self.scans, 7), state_dtype()).at[:, :, 0].set(1.0)
        return poses, jnp.zeros(self.scans, state_dtype()), jnp.zeros(2, state_dtype())

    def add(self, sums: tuple[Any, ...], seen: Observed, truth: TruePose) -> tuple[Any, ...]:
        """Compare the motion since ``scans`` scans ago with the true one."""
        poses, known, total = sums
        new = jnp.stack([seen.nav.T_world_imu.wxyz_xyz, truth.T_world_imu.wxyz_xyz])
        moved, truly = (
            jaxlie.SE3(old[0]).inverse() @ jaxlie.SE3(pose) for old, pose in zip(poses, new, strict=True)
        )
        error = truly.inverse() @ moved
        off = error.rotation().log() if self.rotation else error.translation()
        both = jnp.where(truth.known, known[0], 0.0)
        total += jnp.stack([jnp.where(both > 0, off @ off, 0.0), both])
        poses = jnp.concatenate([poses[:, 1:], new[:, None]], 1)
        return poses, jnp.append(known[1:], jnp.where(truth.known, 1.0, 0.0)), total

    def value(self, sums: tuple[Any, ...]) -> Float[Array, ""]:
        """Return the error; 0 where no motion could be compared."""
        total = sums[2]
        return _root(total[0] / jnp.maximum(total[1], 1.0))


def _root(square: Float[Array, ""]) -> Float[Array, ""]:
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
