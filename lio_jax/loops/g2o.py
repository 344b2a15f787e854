"""Write pose graphs in the g2o text format (VERTEX_SE3:QUAT, EDGE_SE3:QUAT)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.files import atomic_path


@dataclass(frozen=True)
class Edge:
    """A relative pose between two vertices."""

    i: int
    j: int
    T_i_j: NDArray[np.float64]
    """(4, 4)."""
    information: NDArray[np.float64]
    """(6, 6) of the right perturbation of T_i_j: rotation (rad) before translation (m)."""


def write_g2o(path: Path, poses: NDArray[np.float64], edges: list[Edge]) -> None:
    """Write (n, 4, 4) vertices and their edges.

    The file holds translation first; like gtsam, rotations count as rotation vectors.
    """
    order = np.array([3, 4, 5, 0, 1, 2])
    upper = np.triu_indices(6)
    lines = [f"VERTEX_SE3:QUAT {index} {_pose(pose)}" for index, pose in enumerate(poses)]
    for edge in edges:
        information = edge.information[np.ix_(order, order)]
        numbers = " ".join(f"{value:.9g}" for value in information[upper])
        lines.append(f"EDGE_SE3:QUAT {edge.i} {edge.j} {_pose(edge.T_i_j)} {numbers}")
    with atomic_path(path) as aside:
        aside.write_text("\n".join(lines) + "\n")


def _pose(pose: NDArray[np.float64]) -> str:
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return " ".join(f"{value:.12g}" for value in (*pose[:3, 3], *quaternion))
