"""Poses as numpy matrices, for the host's part of a pose graph."""

import jax
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.loops.graph import Poses

_Array = NDArray[np.float64]

_WELL_CONDITIONED = 0.1
"""Determinant of a matrix over that of the rotation's multiple that is as large."""
_STEPS = 10


def numbers_of(poses: Poses) -> _Array:
    """Return what the poses are made of: (w, x, y, z) or (cosine, sine), then the translation.

    jaxlie's own ``parameters()`` is compiled for every number of poses.
    """
    (numbers,) = jax.tree.leaves(poses)
    return np.asarray(numbers)


def rotation_matrices(poses: Poses) -> _Array:
    """Return (n, 3, 3), in the plane (n, 2, 2)."""
    numbers = numbers_of(poses)
    if isinstance(poses, jaxlie.SE3):
        return Rotation.from_quat(numbers[:, :4], scalar_first=True).as_matrix().reshape(-1, 3, 3)
    cosine, sine = (numbers[:, :2] / np.linalg.norm(numbers[:, :2], axis=1, keepdims=True)).T
    return np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)


def translations(poses: Poses) -> _Array:
    """Return (n, 3), in the plane (n, 2)."""
    return numbers_of(poses)[:, 4 if isinstance(poses, jaxlie.SE3) else 2 :]


def matrices_of(poses: Poses) -> _Array:
    """Return (n, 4, 4), in the plane (n, 3, 3)."""
    translation = translations(poses)
    size = translation.shape[-1]
    matrices = np.tile(np.eye(size + 1), (len(translation), 1, 1))
    matrices[:, :size, :size] = rotation_matrices(poses)
    matrices[:, :size, size] = translation
    return matrices


def poses_from(rotation: _Array, translation: _Array) -> Poses:
    """Return the poses of rotation matrices, (n, 3, 3) or (n, 2, 2), and translations."""
    if translation.shape[-1] == 2:
        return jaxlie.SE2(jax.device_put(np.concatenate([rotation[:, :, 0], translation], -1)))
    wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True).reshape(-1, 4)
    return jaxlie.SE3(jax.device_put(np.concatenate([wxyz, translation], -1)))


def nearest_rotations(matrix: _Array) -> _Array:
    """Return the rotation matrices that are nearest to (n, k, k) matrices, in the Frobenius norm.

    ``U diag(1, .., det(U V')) V'`` of the singular value decomposition (Umeyama, "Least-squares estimation of
    transformation parameters between two point patterns", 1991). For matrices not far from a multiple of a
    rotation it is the limit of X <- (X + X^-T) / 2 (Higham, "Computing the polar decomposition with
    applications", 1986), in a tenth of the time.
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
        # the error falls with its square
        if np.max(np.abs(change)) < 1e-8:
            break
    return X.transpose(2, 0, 1)


def heading_of(pose: _Array) -> float:
    """Return the direction of a (4, 4) pose's x axis in the plane, rad."""
    return float(np.arctan2(pose[1, 0], pose[0, 0]))
