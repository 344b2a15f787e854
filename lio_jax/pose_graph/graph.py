"""Pose graphs as arrays, and operations on batches of poses.

Functions of the first part run on the device, in space (SE3) and in the plane (SE2). Functions of the second
part convert poses to and from matrices on the host, in double precision.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Poses = jaxlie.SEBase
"""SE3 or SE2 poses, all of one kind, with one batch axis."""

ODOMETRY, LOOP, PRIOR, POSITION = range(4)
"""Kinds of edge. A prior measures a vertex's pose. A position measures where a point is that is fixed to the
vertex, for example a GPS antenna."""


class PoseGraph(eqx.Module):
    """Vertices, and the measurements between and of them."""

    poses: Poses
    """(n,) estimates of T_world_vertex, m."""
    i: Int[Array, " e"]
    """First vertex of each edge; for a prior and for a position the same as ``j``."""
    j: Int[Array, " e"]
    """Second vertex of each edge."""
    measurement: Poses
    """(e,) measured T_i_j, m; for a prior T_world_j; for a position only the translation is used."""
    information: Float[Array, "e d d"]
    """Inverse covariance of the measurement's right perturbation, rotation (rad) before translation (m). For
    a position it is that of the coordinates in world, with zeros for the rotation."""
    kind: Int[Array, " e"]
    """Kind of each edge: ODOMETRY, LOOP, PRIOR or POSITION."""
    fixed: Bool[Array, " n"]
    """True for vertices that keep their pose."""
    lever: Float[Array, "e k"] | None = None
    """Point whose position was measured, in the frame of ``j``, m; not used for other kinds of edge. None:
    the origin of ``j``."""


Status = Literal["converged", "iteration limit", "no further decrease", "not finite"]
"""Why a solve ended. "no further decrease": even the shortest step did not lower the cost."""


class Solution(eqx.Module):
    """The result of a solve."""

    poses: Poses
    """(n,) T_world_vertex, m."""
    cost: Float[Array, ""]
    """Half of the weighted sum of squared whitened residuals."""
    weights: Float[Array, " e"]
    """Factor of each edge's information: 1, or less where a robust solve rejects an edge."""
    edge_costs: Float[Array, " e"]
    """r' Omega r / 2 of each edge, without its weight."""
    initial_cost: Float[Array, ""]
    """Cost at the graph's own poses, with weight 1 for all edges."""
    iterations: int = eqx.field(static=True)
    """Number of linear systems solved."""
    status: Status = eqx.field(static=True)
    """Why the solve ended."""


def rotation_first(tangent_or_matrix: Float[Array, "*b"], axes: int = 1) -> Float[Array, "*b"]:
    """Return jaxlie's tangents, which have the translation first, with the rotation first.

    Args:
        tangent_or_matrix: its last ``axes`` axes are of a tangent's size, 6 or 3.
        axes: 1 for tangents, 2 for matrices.
    """
    size = tangent_or_matrix.shape[-1]
    return jnp.roll(tangent_or_matrix, 3 if size == 6 else 1, axis=tuple(range(-axes, 0)))


def moved(poses: Poses, step: Float[Array, "n d"]) -> Poses:
    """Return T exp(step).

    Args:
        poses: (n,) poses T, m.
        step: right perturbations, rotation (rad) before translation (m).
    """
    size = step.shape[-1]
    return poses @ type(poses).exp(jnp.roll(step, -3 if size == 6 else -1, axis=-1))


def between(a: Poses, b: Poses) -> Poses:
    """Return a^-1 b for (n,) poses a and (n,) poses b.

    In space the product is written component by component: each single product of jaxlie, of quaternions or
    with points, costs XLA as much as this whole function.
    """
    if not isinstance(a, jaxlie.SE3):
        return a.inverse() @ b
    (numbers_a,), (numbers_b,) = jax.tree.leaves(a), jax.tree.leaves(b)
    w, x, y, z, *from_t = jnp.moveaxis(numbers_a, -1, 0)
    p, q, r, s, *to_t = jnp.moveaxis(numbers_b, -1, 0)
    turn = [
        w * p + x * q + y * r + z * s,
        w * q - x * p - y * s + z * r,
        w * r - y * p - z * q + x * s,
        w * s - z * p - x * r + y * q,
    ]
    # R' v = v - 2 w (u x v) + 2 u x (u x v) with u the quaternion's vector
    vx, vy, vz = (to - start for to, start in zip(to_t, from_t, strict=True))
    cx, cy, cz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    shift = [
        vx + 2 * (y * cz - z * cy - w * cx),
        vy + 2 * (z * cx - x * cz - w * cy),
        vz + 2 * (x * cy - y * cx - w * cz),
    ]
    return jaxlie.SE3(jnp.stack(turn + shift, -1))


def picked(poses: Poses, index: Int[Array, " k"]) -> Poses:
    """Return the (k,) poses at the given indices."""
    return jax.tree.map(lambda leaf: leaf[index], poses)


def tangent_size(poses: Poses) -> int:
    """Return the size of a tangent vector: 6 in space, 3 in the plane."""
    return poses.tangent_dim


_Array = NDArray[np.float64]

_WELL_CONDITIONED = 0.1
"""Least determinant of a matrix for which the iteration is used, over that of a multiple of a rotation with
the same norm."""
_STEPS = 10
"""Largest number of iterations for the nearest rotation."""


def numbers_of(poses: Poses) -> _Array:
    """Return the poses' parameters: (w, x, y, z) or (cosine, sine), then the translation (m).

    jaxlie's own ``parameters()`` would compile for each number of poses.
    """
    (numbers,) = jax.tree.leaves(poses)
    return np.asarray(numbers)


def rotation_matrices(poses: Poses) -> _Array:
    """Return the rotation matrices, (n, 3, 3) in space and (n, 2, 2) in the plane."""
    numbers = numbers_of(poses)
    if isinstance(poses, jaxlie.SE3):
        return Rotation.from_quat(numbers[:, :4], scalar_first=True).as_matrix().reshape(-1, 3, 3)
    cosine, sine = (numbers[:, :2] / np.linalg.norm(numbers[:, :2], axis=1, keepdims=True)).T
    return np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)


def translations(poses: Poses) -> _Array:
    """Return the translations, m, (n, 3) in space and (n, 2) in the plane."""
    return numbers_of(poses)[:, 4 if isinstance(poses, jaxlie.SE3) else 2 :]


def matrices_of(poses: Poses) -> _Array:
    """Return the homogeneous matrices, (n, 4, 4) in space and (n, 3, 3) in the plane."""
    translation = translations(poses)
    size = translation.shape[-1]
    matrices = np.tile(np.eye(size + 1), (len(translation), 1, 1))
    matrices[:, :size, :size] = rotation_matrices(poses)
    matrices[:, :size, size] = translation
    return matrices


def poses_from(rotation: _Array, translation: _Array) -> Poses:
    """Return the poses of rotation matrices and translations.

    Args:
        rotation: (n, 3, 3) or (n, 2, 2).
        translation: (n, 3) or (n, 2), m.
    """
    if translation.shape[-1] == 2:
        return jaxlie.SE2(jax.device_put(np.concatenate([rotation[:, :, 0], translation], -1)))
    wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True).reshape(-1, 4)
    return jaxlie.SE3(jax.device_put(np.concatenate([wxyz, translation], -1)))


def nearest_rotations(matrix: _Array) -> _Array:
    """Return the rotation matrices that are nearest to (n, k, k) matrices, in the Frobenius norm.

    The nearest rotation is ``U diag(1, .., det(U V')) V'`` of the singular value decomposition (Umeyama,
    "Least-squares estimation of transformation parameters between two point patterns", 1991). For 3 x 3
    matrices near a multiple of a rotation it is computed as the limit of X <- (X + X^-T) / 2 (Higham,
    "Computing the polar decomposition with applications", 1986), which takes a tenth of the time.
    """
    size = matrix.shape[-1]
    determinant = np.linalg.det(matrix)
    scale = np.linalg.norm(matrix, axis=(1, 2)) / np.sqrt(size)
    near = determinant > _WELL_CONDITIONED * scale**size
    if size == 3 and np.any(near):
        nearest = np.empty_like(matrix)
        nearest[near] = _orthogonalised(matrix[near] / scale[near, None, None])
        nearest[~near] = _by_singular_values(matrix[~near])
        return nearest
    return _by_singular_values(matrix)


def _by_singular_values(matrix: _Array) -> _Array:
    left, _, right = np.linalg.svd(matrix)
    left[:, :, -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right


def _orthogonalised(matrix: _Array) -> _Array:
    X = np.ascontiguousarray(matrix.transpose(1, 2, 0))
    for _ in range(_STEPS):
        a, b, c = X
        cofactors = np.stack([np.cross(b, c, axis=0), np.cross(c, a, axis=0), np.cross(a, b, axis=0)])
        change = (cofactors / np.sum(a * cofactors[0], 0) - X) / 2
        X = X + change
        # the convergence is quadratic
        if np.max(np.abs(change)) < 1e-8:
            break
    return X.transpose(2, 0, 1)


def heading_of(pose: _Array) -> float:
    """Return the direction of a (4, 4) pose's x axis in the plane, rad."""
    return float(np.arctan2(pose[1, 0], pose[0, 0]))
