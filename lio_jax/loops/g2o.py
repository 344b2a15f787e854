"""Write pose graphs in the g2o text format (VERTEX and EDGE of SE3:QUAT and SE2, FIX)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.files import atomic_path
from lio_jax.loops.graph import PRIOR, PoseGraph, Poses
from lio_jax.loops.host_poses import numbers_of

_Array = NDArray[np.float64]


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
    measured = np.array([edge.T_i_j for edge in edges]).reshape(-1, 4, 4)
    information = np.array([edge.information for edge in edges]).reshape(-1, 6, 6)
    ends = np.array([(edge.i, edge.j) for edge in edges], np.int64).reshape(-1, 2)
    lines = _lines("VERTEX_SE3:QUAT", np.arange(len(poses))[:, None], _of_matrices(poses))
    lines += _lines("EDGE_SE3:QUAT", ends, np.hstack([_of_matrices(measured), _triangle(information)]))
    _write(path, lines)


def write_graph(path: Path, graph: PoseGraph, ids: NDArray[np.int64]) -> None:
    """Write a graph of odometry and loops.

    Args:
        path: of the file.
        graph: without priors and positions, which the format's usual tags don't tell.
        ids: (n,) numbers of the vertices.

    Raises:
        ValueError: there are priors or positions.
    """
    if np.any(np.asarray(graph.kind) >= PRIOR):
        raise ValueError("g2o's usual tags tell neither priors nor positions")
    kind = "SE3:QUAT" if isinstance(graph.poses, jaxlie.SE3) else "SE2"
    ends = ids[np.stack([np.asarray(graph.i), np.asarray(graph.j)], -1)]
    information = _triangle(np.asarray(graph.information, np.float64))
    lines = _lines(f"VERTEX_{kind}", ids[:, None], _of_poses(graph.poses))
    lines += [f"FIX {number}" for number in ids[np.asarray(graph.fixed)]]
    lines += _lines(f"EDGE_{kind}", ends, np.hstack([_of_poses(graph.measurement), information]))
    _write(path, lines)


def _of_matrices(poses: _Array) -> _Array:
    """Return rows x y z qx qy qz qw."""
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat().reshape(-1, 4)
    return np.hstack([poses[:, :3, 3], quaternion])


def _of_poses(poses: Poses) -> _Array:
    """Return rows x y z qx qy qz qw, in the plane x y angle."""
    numbers = numbers_of(poses)
    if isinstance(poses, jaxlie.SE3):
        return numbers[:, [4, 5, 6, 1, 2, 3, 0]]
    return np.column_stack([numbers[:, 2:], np.arctan2(numbers[:, 1], numbers[:, 0])])


def _triangle(information: _Array) -> _Array:
    """Return the upper triangles, translation first, of matrices that count rotation first."""
    size = information.shape[-1]
    turned = np.roll(information, -3 if size == 6 else -1, axis=(1, 2))
    return turned[:, *np.triu_indices(size)]


def _lines(tag: str, integers: NDArray[np.int64], numbers: _Array) -> list[str]:
    form = " ".join([tag, *["%d"] * integers.shape[1], *["%.15g"] * numbers.shape[1]])
    rows = zip(integers.tolist(), numbers.tolist(), strict=True)
    return [form % (*whole, *real) for whole, real in rows]


def _write(path: Path, lines: Sequence[str]) -> None:
    with atomic_path(path) as aside:
        aside.write_text("\n".join(lines) + "\n")
