"""Covariances of a pose's right perturbation d in T exp(d): rotation (rad), then translation (m)."""

import numpy as np
from numpy.typing import NDArray


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
