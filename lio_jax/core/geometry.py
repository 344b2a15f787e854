"""Closed forms on 3-vectors and symmetric 3x3 matrices, written for large batches.

A symmetric matrix is given as its diagonal (xx, yy, zz) and its off-diagonal (xy, xz, yz).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def largest_eigenvalue3(
    diagonal: Float[Array, "*b 3"], off_diagonal: Float[Array, "*b 3"]
) -> Float[Array, "*b"]:
    """Return the largest eigenvalue by the trigonometric solution of the characteristic cubic.

    Source: Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961.
    """
    mean = jnp.mean(diagonal, -1)
    ax, ay, az = jnp.moveaxis(diagonal - mean[..., None], -1, 0)
    spread = (ax**2 + ay**2 + az**2 + 2 * jnp.sum(off_diagonal**2, -1)) / 6
    p = jnp.sqrt(jnp.maximum(spread, jnp.finfo(diagonal.dtype).tiny))
    # divided entry by entry, because p cubed underflows for a voxel of nearly coincident points
    ax, ay, az = ax / p, ay / p, az / p
    xy, xz, yz = jnp.moveaxis(off_diagonal / p[..., None], -1, 0)
    determinant = ax * (ay * az - yz**2) - xy * (xy * az - yz * xz) + xz * (xy * yz - ay * xz)
    return mean + 2 * p * jnp.cos(jnp.arccos(jnp.clip(determinant / 2, -1.0, 1.0)) / 3)


def inverse3(
    diagonal: Float[Array, "*b 3"], off_diagonal: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Return diagonal and off-diagonal of the inverse, by cofactors."""
    xx, yy, zz = jnp.moveaxis(diagonal, -1, 0)
    xy, xz, yz = jnp.moveaxis(off_diagonal, -1, 0)
    cxx, cxy, cxz = yy * zz - yz**2, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = (xx * cxx + xy * cxy + xz * cxz)[..., None]
    cofactors = jnp.stack([cxx, xx * zz - xz**2, xx * yy - xy**2], -1)
    off_cofactors = jnp.stack([cxy, cxz, xy * xz - xx * yz], -1)
    return cofactors / determinant, off_cofactors / determinant


def symmetric3(diagonal: Float[Array, "*b 3"], off_diagonal: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Assemble full matrices."""
    xx, yy, zz = jnp.moveaxis(diagonal, -1, 0)
    xy, xz, yz = jnp.moveaxis(off_diagonal, -1, 0)
    return jnp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(*xx.shape, 3, 3)
