"""Small matrices: cross products, rotations, symmetric 3 x 3 eigenproblems, and matrices from blocks."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.xla import computed_once

_ENTRY = np.array([[0, 2, 1], [2, 0, 0], [1, 0, 0]], np.int32)
_SIGN = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]], np.int32)


def skew(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Return the skew-symmetric matrix whose product with a vector w is the cross product ``vector`` x w."""
    return jnp.take(vector, _ENTRY, axis=-1, mode="clip") * _SIGN


def dot3(left: Float[Array, "*b 3"], right: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    """Return the inner products of vectors along the last axis.

    XLA's CPU backend reduces an axis in a kernel of its own, which takes longer than three components that
    are added in the kernel that uses the result.
    """
    x, y, z = (left[..., i] * right[..., i] for i in range(3))
    return x + y + z


@jax.jit
def rotation_matrix(rotation: jaxlie.SO3) -> Float[Array, "*b 3 3"]:
    """Return the rotation matrix of a quaternion (w, v) of any length above zero.

    ``R = (2 w^2 / n - 1) I + 2 / n (v v' + w V)`` with V the cross product with v and n = w^2 + v'v.
    """
    wxyz = rotation.wxyz
    twice = (2 / jnp.sum(wxyz**2, -1))[..., None, None]
    w, v = wxyz[..., :1, None], wxyz[..., 1:]
    return (twice * w**2 - 1) * np.eye(3, dtype=wxyz.dtype) + twice * (
        v[..., :, None] * v[..., None, :] + w * skew(v)
    )


def eigenvalues_and_normal3(
    diagonal: Float[Array, "*b 3"], off_diagonal: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Return ascending eigenvalues and the unit eigenvector of the smallest one, without LAPACK.

    The eigenvalue farthest from the other two comes from the trigonometric solution of the characteristic
    cubic (Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961). Its eigenvector is the longest cross
    product of two rows of A - lambda I. The other two eigenvalues come from the 2 x 2 problem in the plane
    normal to that eigenvector (Eberly, "A robust eigensolver for 3 x 3 symmetric matrices", 2014). The result
    has float32's precision for flat, thin and round distributions. Where all three eigenvalues coincide, the
    eigenvector is (0, 0, 1).

    Args:
        diagonal: entries xx, yy and zz of the symmetric matrix.
        off_diagonal: entries xy, xz and yz.
    """
    tiny = jnp.finfo(diagonal.dtype).tiny
    mean = (diagonal[..., 0] + diagonal[..., 1] + diagonal[..., 2]) / 3
    # scaled entry by entry, because products of three underflow for nearly coincident points
    centred = diagonal - mean[..., None]
    spread = dot3(centred, centred) + 2 * dot3(off_diagonal, off_diagonal)
    p = jnp.sqrt(jnp.maximum(spread / 6, tiny))
    round_shape = p <= 8 * jnp.finfo(diagonal.dtype).eps * jnp.abs(mean)
    scale = jnp.where(round_shape, 0.0, 1 / p)[..., None]
    ax, ay, az = jnp.moveaxis(centred * scale, -1, 0)
    xy, xz, yz = jnp.moveaxis(off_diagonal * scale, -1, 0)
    determinant = ax * (ay * az - yz**2) - xy * (xy * az - yz * xz) + xz * (xy * yz - ay * xz)
    thin = determinant > 0
    angle = jnp.arccos(jnp.clip(jnp.abs(determinant) / 2, 0.0, 1.0)) / 3
    apart = jnp.where(thin, 2.0, -2.0) * jnp.cos(angle)

    bx, by, bz = ax - apart, ay - apart, az - apart
    axis = computed_once(
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
    # one of the two rows of the 2x2 problem suffers no cancellation: take that one
    along_u = jnp.where(half > 0, uv, radius - half)
    along_v = jnp.where(half > 0, -(half + radius), -uv)
    lowest = along_u[..., None] * u + along_v[..., None] * v
    normal = jnp.where(thin[..., None], _longest(lowest), axis)
    values = jnp.where(thin[..., None], jnp.stack([low, high, apart], -1), jnp.stack([apart, low, high], -1))
    return mean[..., None] + p[..., None] * values, normal


def normal_slope3(
    matrix: Float[Array, "k 3 3"], normal: Float[Array, "k 3"], change: Float[Array, "k 3 3"]
) -> tuple[Float[Array, "k 3"], Float[Array, "k 2"]]:
    """Return how the eigenvector of the smallest eigenvalue and the two smaller eigenvalues change.

    With A n = l n, a change dA turns the eigenvector by -(A - l I)^+ dA n and changes the eigenvalue of v by
    v' dA v (Magnus, "On differentiating eigenvalues and eigenvectors", 1985). In the inverse, a gap g between
    eigenvalues becomes (g^2 + e^2) / g with a tiny e, because the eigenvector is undefined where two of them
    meet.

    Args:
        matrix: symmetric, such as covariances in m^2.
        normal: unit eigenvectors of the smallest eigenvalues.
        change: symmetric.
    """
    first, second = across(normal)
    n, u, v = normal.T, first.T, second.T
    A, dA = jnp.moveaxis(matrix, 0, -1), jnp.moveaxis(change, 0, -1)

    def within(of: Array, left: Array, right: Array) -> Array:
        # sums of products over whole columns: XLA makes slow loops of many products of 3 x 3 matrices
        turned = [of[i, 0] * right[0] + of[i, 1] * right[1] + of[i, 2] * right[2] for i in range(3)]
        return left[0] * turned[0] + left[1] * turned[1] + left[2] * turned[2]

    smallest, change_of_smallest = within(A, n, n), within(dA, n, n)
    uu, vv, mixed = within(A, u, u), within(A, v, v), within(A, u, v)
    d_uu, d_vv, d_mixed = within(dA, u, u), within(dA, v, v), within(dA, u, v)
    half = (uu - vv) / 2
    radius = jnp.sqrt(jnp.maximum(half**2 + mixed**2, 1e-30))
    change_of_radius = (half * (d_uu - d_vv) / 2 + mixed * d_mixed) / radius
    change_of_middle = (d_uu + d_vv) / 2 - change_of_radius

    middle = (uu + vv) / 2 - smallest
    least = _LEAST_GAP * jnp.abs(uu + vv) + _LEAST_VARIANCE
    low, high = (gap / (gap**2 + least**2) for gap in (middle - radius, middle + radius))
    mean_inverse = (low + high) / 2
    cosine, sine = ((high - low) / 2 * side / radius for side in (half, mixed))
    c, d = within(dA, u, n), within(dA, v, n)
    by_first = mean_inverse * c + cosine * c + sine * d
    by_second = mean_inverse * d + sine * c - cosine * d
    turn = -(by_first[:, None] * first + by_second[:, None] * second)
    return turn, jnp.stack([change_of_smallest, change_of_middle], -1)


_LEAST_GAP = 1e-6
"""Share of the larger eigenvalues below which the gap between the two smaller ones counts as none."""
_LEAST_VARIANCE = 1e-9
"""The same for all eigenvalues, m^2: points may coincide."""


def across(axis: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
    """Return two unit vectors that are perpendicular to a unit vector and to each other.

    Args:
        axis: of unit length.
    """
    x, y, z = jnp.moveaxis(axis, -1, 0)
    zero = jnp.zeros_like(x)
    slanted = (jnp.abs(x) > jnp.abs(y))[..., None]
    u = _longest(jnp.where(slanted, jnp.stack([-z, zero, x], -1), jnp.stack([zero, z, -y], -1)))
    return u, jnp.cross(axis, u)


def _longest(*candidates: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Return the longest of the vectors at unit length; (0, 0, 1) where all are zero."""
    best, *others = candidates
    length = dot3(best, best)
    for vector in others:
        squared = dot3(vector, vector)
        best = jnp.where((squared > length)[..., None], vector, best)
        length = jnp.maximum(squared, length)
    zero = length <= jnp.finfo(best.dtype).tiny
    up = jnp.array([0, 0, 1], best.dtype)
    return jnp.where(zero[..., None], up, best / jnp.sqrt(jnp.where(zero, 1, length))[..., None])


def from_blocks(
    shape: tuple[int, int], *blocks: tuple[slice, slice, Float[Array, "_ _"]]
) -> Float[Array, "n m"]:
    """Return a matrix of the given blocks and zeros elsewhere; blocks that overlap are added.

    The whole matrix is one compiled kernel. Setting the blocks one by one would compile a kernel for each.

    Args:
        shape: number of rows and columns of the matrix.
        blocks: the rows, the columns and the entries of each block; all entries have one dtype.
    """
    padded = []
    for rows, columns, block in blocks:
        places = [place.indices(size)[:2] for place, size in zip((rows, columns), shape, strict=True)]
        margins = [(start, size - stop, 0) for (start, stop), size in zip(places, shape, strict=True)]
        padded.append(jax.lax.pad(block, jnp.zeros((), block.dtype), margins))
    return sum(padded[1:], padded[0])


def adjoint(pose: jaxlie.SE3) -> Float[Array, "6 6"]:
    """Return Ad with T exp(d) = exp(Ad d) T, where d holds the rotation (rad) before the translation (m).

    jaxlie's own adjoint is for the other order.
    """
    turn, move = slice(0, 3), slice(3, 6)
    matrix = rotation_matrix(pose.rotation())
    return from_blocks(
        (6, 6), (turn, turn, matrix), (move, move, matrix), (move, turn, skew(pose.translation()) @ matrix)
    )


@jax.custom_jvp
def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the inverse of a small matrix, with the derivative -X dA X of X = A^-1.

    JAX's own derivative solves a system with as many right sides as there are tangents. The linear algebra
    library takes threads for these, and waking them takes longer than the products.
    """
    return jnp.linalg.inv(matrix)


@inverse.defjvp
def _inverse_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    found = inverse(*primals)
    return found, -found @ tangents[0] @ found


def covariance_of(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a (6, 6) information matrix; all NaN if a direction is unobservable."""
    try:
        root = np.linalg.inv(np.linalg.cholesky(information))
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan)
    return root.T @ root


def carried(covariance: NDArray[np.float64], T_b_a: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance of T_world_b, given that of T_world_a = T_world_b T_b_a.

    Args:
        covariance: (6, 6) of T_world_a.
        T_b_a: (4, 4) pose of a in b, without error.
    """
    adjoint = adjoint_of(T_b_a)
    return adjoint @ covariance @ adjoint.T


def adjoint_of(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (6, 6) adjoint A of a (4, 4) pose: T exp(d) = exp(A d) T, rotation before translation."""
    rotation, (x, y, z) = T[:3, :3], T[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[rotation, np.zeros((3, 3))], [cross @ rotation, rotation]])
