"""Poses as numpy matrices, for the host's part of a pose graph."""

import jax
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.loops.graph import Poses

_Array = NDArray[np.float64]


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
    transformation parameters between two point patterns", 1991).
    """
    left, _, right = np.linalg.svd(matrix)
    left[:, :, -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right


def heading_of(pose: _Array) -> float:
    """Return the direction of a (4, 4) pose's x axis in the plane, rad."""
    return float(np.arctan2(pose[1, 0], pose[0, 0]))
