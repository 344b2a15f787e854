"""Closed forms on 3-vectors and symmetric 3x3 matrices, written for large batches.

A symmetric matrix is given as its diagonal (xx, yy, zz) and its off-diagonal (xy, xz, yz).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def eigenvalues_and_normal3(
    diagonal: Float[Array, "*b 3"], off_diagonal: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Return ascending eigenvalues and the unit eigenvector of the smallest one, without LAPACK.

    Eigenvalues by the trigonometric solution of the characteristic cubic (Smith, "Eigenvalues of a symmetric
    3 x 3 matrix", CACM 1961); the eigenvector as the longest cross product of two rows of A - lambda I. The
    smallest eigenvalue is then replaced by its Rayleigh quotient, because the cubic loses it in float32 where
    the matrix is flat. Where all three coincide the eigenvector is (0, 0, 1).
    """
    tiny = jnp.finfo(diagonal.dtype).tiny
    mean = jnp.mean(diagonal, -1)
    # scaled entry by entry, because products of three underflow for nearly coincident points
    spread = jnp.sum((diagonal - mean[..., None]) ** 2, -1) + 2 * jnp.sum(off_diagonal**2, -1)
    p = jnp.sqrt(jnp.maximum(spread / 6, tiny))
    ax, ay, az = jnp.moveaxis((diagonal - mean[..., None]) / p[..., None], -1, 0)
    xy, xz, yz = jnp.moveaxis(off_diagonal / p[..., None], -1, 0)
    determinant = ax * (ay * az - yz**2) - xy * (xy * az - yz * xz) + xz * (xy * yz - ay * xz)
    angle = jnp.arccos(jnp.clip(determinant / 2, -1.0, 1.0)) / 3
    largest, smallest = 2 * jnp.cos(angle), 2 * jnp.cos(angle + 2 * jnp.pi / 3)

    bx, by, bz = ax - smallest, ay - smallest, az - smallest
    normal = _longest(
        jnp.stack([xy * yz - xz * by, xz * xy - bx * yz, bx * by - xy**2], -1),
        jnp.stack([xy * bz - xz * yz, xz**2 - bx * bz, bx * yz - xy * xz], -1),
        jnp.stack([by * bz - yz**2, yz * xz - xy * bz, xy * yz - by * xz], -1),
    )
    nx, ny, nz = jnp.moveaxis(normal, -1, 0)
    smallest = nx * (ax * nx + 2 * xy * ny) + ny * (ay * ny + 2 * yz * nz) + nz * (az * nz + 2 * xz * nx)
    scaled = jnp.stack([smallest, -smallest - largest, largest], -1)
    return mean[..., None] + p[..., None] * scaled, normal


def _longest(*candidates: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Return the longest of the vectors at unit length; (0, 0, 1) where all are zero."""
    best, *others = candidates
    length = jnp.sum(best**2, -1)
    for vector in others:
        squared = jnp.sum(vector**2, -1)
        best = jnp.where((squared > length)[..., None], vector, best)
        length = jnp.maximum(squared, length)
    zero = length <= jnp.finfo(best.dtype).tiny
    up = jnp.array([0, 0, 1], best.dtype)
    return jnp.where(zero[..., None], up, best / jnp.sqrt(jnp.where(zero, 1, length))[..., None])
