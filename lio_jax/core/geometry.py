"""Closed forms on 3-vectors and symmetric 3x3 matrices, written for large batches.

A symmetric matrix is given as its diagonal (xx, yy, zz) and its off-diagonal (xy, xz, yz).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.materialise import materialised


def eigenvalues_and_normal3(
    diagonal: Float[Array, "*b 3"], off_diagonal: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Return ascending eigenvalues and the unit eigenvector of the smallest one, without LAPACK.

    The eigenvalue that stands apart from the other two comes from the trigonometric solution of the
    characteristic cubic (Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961) and its eigenvector
    from the longest cross product of two rows of A - lambda I; the other two come from the 2x2 problem in
    the plane across it (Eberly, "A robust eigensolver for 3 x 3 symmetric matrices", 2014). Flat, thin and
    round voxels are all solved to float32's precision. Where all three coincide the eigenvector is (0, 0, 1).
    """
    tiny = jnp.finfo(diagonal.dtype).tiny
    mean = jnp.mean(diagonal, -1)
    # scaled entry by entry, because products of three underflow for nearly coincident points
    spread = jnp.sum((diagonal - mean[..., None]) ** 2, -1) + 2 * jnp.sum(off_diagonal**2, -1)
    p = jnp.sqrt(jnp.maximum(spread / 6, tiny))
    round_shape = p <= 8 * jnp.finfo(diagonal.dtype).eps * jnp.abs(mean)
    scale = jnp.where(round_shape, 0.0, 1 / p)[..., None]
    ax, ay, az = jnp.moveaxis((diagonal - mean[..., None]) * scale, -1, 0)
    xy, xz, yz = jnp.moveaxis(off_diagonal * scale, -1, 0)
    determinant = ax * (ay * az - yz**2) - xy * (xy * az - yz * xz) + xz * (xy * yz - ay * xz)
    thin = determinant > 0
    angle = jnp.arccos(jnp.clip(jnp.abs(determinant) / 2, 0.0, 1.0)) / 3
    apart = jnp.where(thin, 2.0, -2.0) * jnp.cos(angle)

    bx, by, bz = ax - apart, ay - apart, az - apart
    axis = materialised(
        _longest(
            jnp.stack([xy * yz - xz * by, xz * xy - bx * yz, bx * by - xy**2], -1),
            jnp.stack([xy * bz - xz * yz, xz**2 - bx * bz, bx * yz - xy * xz], -1),
            jnp.stack([by * bz - yz**2, yz * xz - xy * bz, xy * yz - by * xz], -1),
        )
    )
    u, v = across(axis)

    def form(left: Array, right: Array) -> Array:
        (lx, ly, lz), (rx, ry, rz) = jnp.moveaxis(left, -1, 0), jnp.moveaxis(right, -1, 0)
        mixed = xy * (lx * ry + ly * rx) + xz * (lx * rz + lz * rx) + yz * (ly * rz + lz * ry)
        return ax * lx * rx + ay * ly * ry + az * lz * rz + mixed

    apart = form(axis, axis)
    uu, uv, vv = form(u, u), form(u, v), form(v, v)
    middle, half = (uu + vv) / 2, (uu - vv) / 2
    radius = jnp.sqrt(jnp.maximum(half**2 + uv**2, 1e-30))
    low, high = middle - radius, middle + radius
    # of the two rows of the 2x2 problem the one that does not cancel
    along_u = jnp.where(half > 0, uv, radius - half)
    along_v = jnp.where(half > 0, -(half + radius), -uv)
    lowest = along_u[..., None] * u + along_v[..., None] * v
    normal = jnp.where(thin[..., None], _longest(lowest), axis)
    values = jnp.where(thin[..., None], jnp.stack([low, high, apart], -1), jnp.stack([apart, low, high], -1))
    return mean[..., None] + p[..., None] * values, normal


def across(axis: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Return two unit vectors that are perpendicular to a unit vector and to each other."""
    x, y, z = jnp.moveaxis(axis, -1, 0)
    zero = jnp.zeros_like(x)
    slanted = (jnp.abs(x) > jnp.abs(y))[..., None]
    u = _longest(jnp.where(slanted, jnp.stack([-z, zero, x], -1), jnp.stack([zero, z, -y], -1)))
    return u, jnp.cross(axis, u)


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
