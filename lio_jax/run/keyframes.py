"""Pick keyframes from a trajectory and chain them into a pose graph."""

import numpy as np
from numpy.typing import NDArray

from lio_jax.loops.g2o import Edge
from lio_jax.run.covariance import carried


def keyframe_indices(poses: NDArray[np.float64], distance: float, angle: float) -> list[int]:
    """Return the poses that moved or turned enough since the last one returned, the first included.

    Args:
        poses: (n, 4, 4).
        distance: m.
        angle: rad.
    """
    chosen = [0]
    for index in range(1, len(poses)):
        moved = np.linalg.inv(poses[chosen[-1]]) @ poses[index]
        turned = np.arccos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1.0, 1.0))
        if np.linalg.norm(moved[:3, 3]) > distance or turned > angle:
            chosen.append(index)
    return chosen


def odometry_edges(poses: NDArray[np.float64], covariances: NDArray[np.float64]) -> list[Edge]:
    """Return the edges between consecutive poses, their errors taken as independent.

    A relative pose T_i_j = T_i^-1 T_j has covariance S_j + A S_i A', with A the adjoint of T_j_i. Where a
    covariance is unknown the edge gets a sigma of 0.1 rad and 1 m.

    Args:
        poses: (n, 4, 4).
        covariances: (n, 6, 6) of each pose's right perturbation, rotation first; NaN where unknown.
    """
    loose = np.diag([1e2] * 3 + [1.0] * 3)
    edges = []
    for i in range(len(poses) - 1):
        T_i_j = np.linalg.inv(poses[i]) @ poses[i + 1]
        covariance = covariances[i + 1] + carried(covariances[i], np.linalg.inv(T_i_j))
        known = np.isfinite(covariance).all()
        edges.append(Edge(i, i + 1, T_i_j, np.linalg.inv(covariance) if known else loose))
    return edges
