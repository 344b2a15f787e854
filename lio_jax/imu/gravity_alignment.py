"""Gyro bias, velocities and gravity that make matched poses and inertial samples agree.

The linear alignment of Qin et al., "VINS-Mono" (T-RO 2018), section V-B, with poses that are metric and have
noise of their own, and gravity of known strength throughout.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.error_state import POSITION, ROTATION, VELOCITY
from lio_jax.core.params import ImuParams, InitialParams
from lio_jax.core.rotation import rotation_matrix, skew
from lio_jax.imu.preintegration import Preintegrated

SPHERE_ROUNDS = 4


class Scale(eqx.Module):
    """Standard deviations that whiten the alignment's equations."""

    pose: Float[Array, ""]
    speed: Float[Array, " n"]
    way: Float[Array, " n"]
    """Of the way gained beyond that of the mean speed: this part is independent of the speed's error."""
    accel_bias: Float[Array, ""]


class Aligned(eqx.Module):
    """The alignment's unknowns; its order is that of the columns."""

    position: Float[Array, "k 3"]
    velocity: Float[Array, "k 3"]
    accel_share: Float[Array, "3"]
    """Accelerometer bias over its prior sigma: a zero sigma freezes it."""
    gravity: Float[Array, "3"]


def gyro_bias_share(
    gain: Preintegrated,
    rotation: jaxlie.SO3,
    duration: Float[Array, " n"],
    share: Float[Array, "3"],
    params: ImuParams,
    initial: InitialParams,
    rotation_sigma: Float[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, ""]]:
    """Return bias over its prior sigma, the bias's covariance and the squared misfit of the rotations."""
    wxyz = rotation.wxyz
    turned = jax.vmap(lambda gained, a, b: (gained.inverse() @ a.inverse() @ b).log())(
        gain.rotation, jaxlie.SO3(wxyz[:-1]), jaxlie.SO3(wxyz[1:])
    )
    # neighbouring spans share the error of the pose between them
    spans = duration.shape[0]
    shared = 2 * jnp.eye(spans) - jnp.eye(spans, k=1) - jnp.eye(spans, k=-1)
    noise = jnp.diag(params.gyro_noise**2 * duration) + rotation_sigma**2 * shared
    root = jnp.linalg.cholesky(noise.astype(duration.dtype))

    def whitened(rows: Array) -> Array:
        flat = rows.reshape(spans, -1)
        return jax.scipy.linalg.solve_triangular(root, flat, lower=True).reshape(-1, *rows.shape[2:])

    sigma = initial.gyro_bias_sigma
    A = whitened(gain.bias_jacobian[:, ROTATION, :3]) * sigma
    target = whitened(turned) + A @ share
    information = A.T @ A + jnp.eye(3)
    share = jnp.linalg.solve(information, A.T @ target)
    return share, sigma**2 * jnp.linalg.inv(information), jnp.sum((target - A @ share) ** 2)


def align(
    gain: Preintegrated,
    T_near_imu: jaxlie.SE3,
    matrices: Float[Array, "k 3 3"],
    duration: Float[Array, " n"],
    gravity_strength: Float[Array, ""],
    scale: Scale,
) -> tuple[Aligned, Float[Array, "c c"], Float[Array, ""]]:
    """Return velocities, gravity and accelerometer bias, their covariance and the squared misfit."""
    dt = duration[:, None]
    turn = matrices[:-1]
    matched = T_near_imu.translation()

    gained_frame = rotation_matrix(gain.rotation)
    speed_by_bias = gained_frame @ gain.bias_jacobian[:, VELOCITY, 3:]
    way_by_bias = gained_frame @ gain.bias_jacobian[:, POSITION, 3:]

    def misfit(x: Aligned) -> tuple[Float[Array, " r"], Float[Array, ""]]:
        bias = scale.accel_bias * x.accel_share
        gained = gain.velocity + speed_by_bias @ bias
        moved = gain.position + way_by_bias @ bias
        speed = x.velocity[1:] - x.velocity[:-1] - x.gravity * dt - jnp.einsum("nij,nj->ni", turn, gained)
        way = x.position[1:] - x.position[:-1] - x.velocity[:-1] * dt - x.gravity * dt**2 / 2
        way = way - jnp.einsum("nij,nj->ni", turn, moved) - speed * dt / 2
        rows = jnp.concatenate(
            [
                ((x.position - matched) / scale.pose).ravel(),
                (speed / scale.speed[:, None]).ravel(),
                (way / scale.way[:, None]).ravel(),
                x.accel_share,
            ]
        )
        return rows, jnp.sum(rows[:-3] ** 2)

    def of_known_strength(x: Aligned) -> Aligned:
        strength = jnp.maximum(jnp.linalg.norm(x.gravity), jnp.finfo(dt.dtype).tiny)
        return eqx.tree_at(lambda s: s.gravity, x, x.gravity * (gravity_strength / strength))

    size = 2 * matched.size + 5

    def round_of(x: Aligned, _: None) -> tuple[Aligned, Float[Array, "c c"]]:
        axes = -skew(x.gravity) @ axes_across(x.gravity)
        step, covariance = _least_squares(lambda d: misfit(_moved(x, d, axes))[0], size, dt.dtype)
        return of_known_strength(_moved(x, step, axes)), covariance

    mean_velocity = jnp.diff(matched, axis=0) / dt
    elapsed = jnp.sum(duration) - (duration[0] + duration[-1]) / 2
    acceleration = (mean_velocity[-1] - mean_velocity[0]) / jnp.maximum(elapsed, duration[0])
    force = jnp.mean(jnp.einsum("nij,nj->ni", turn, gain.velocity) / dt, axis=0)
    x = Aligned(
        matched,
        jnp.concatenate([mean_velocity, mean_velocity[-1:]]),
        jnp.zeros(3, dt.dtype),
        acceleration - force,
    )
    x, covariances = jax.lax.scan(round_of, of_known_strength(x), None, SPHERE_ROUNDS)
    return x, covariances[-1], misfit(x)[1]


def axes_across(gravity: Float[Array, "3"]) -> Float[Array, "3 2"]:
    """Return two unit axes normal to ``gravity``, whatever its direction."""
    up = gravity / jnp.linalg.norm(gravity)
    slanted = jnp.eye(3, dtype=up.dtype)[jnp.argmin(jnp.abs(up))]
    a = jnp.cross(up, slanted)
    a = a / jnp.linalg.norm(a)
    return jnp.stack([a, jnp.cross(up, a)], axis=1)


def _moved(x: Aligned, step: Float[Array, " c"], axes: Float[Array, "3 g"]) -> Aligned:
    """Return the unknowns after a step, gravity's part given along ``axes``."""
    poses = x.position.size
    return Aligned(
        x.position + step[:poses].reshape(-1, 3),
        x.velocity + step[poses : 2 * poses].reshape(-1, 3),
        x.accel_share + step[2 * poses : 2 * poses + 3],
        x.gravity + axes @ step[2 * poses + 3 :],
    )


def _least_squares(
    misfit: Callable[[Float[Array, " c"]], Float[Array, " r"]], size: int, dtype: jnp.dtype
) -> tuple[Float[Array, " c"], Float[Array, "c c"]]:
    """Return the step that solves a linear problem and the solution's covariance."""
    zero = jnp.zeros(size, dtype)
    # orthogonal factors, because the normal equations square a condition that is high already
    q, r = jnp.linalg.qr(jax.jacfwd(misfit)(zero))
    inverse = jax.scipy.linalg.solve_triangular(r, jnp.eye(size, dtype=dtype))
    return -(inverse @ (q.T @ misfit(zero))), inverse @ inverse.T
