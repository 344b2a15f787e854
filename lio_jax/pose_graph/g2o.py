"""Read and write pose graphs as g2o files."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jaxlie
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path, read_text
from lio_jax.pose_graph.graph import LOOP, ODOMETRY, PRIOR, PoseGraph, Poses, numbers_of
from lio_jax.pose_graph.structure import parts_of

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class G2oEdge:
    """A measured relative pose between two vertices."""

    i: int
    """Number of the first vertex."""
    j: int
    """Number of the second vertex."""
    T_i_j: NDArray[np.float64]
    """(4, 4) pose of the second vertex in the frame of the first, m."""
    information: NDArray[np.float64]
    """(6, 6) information of the right perturbation of T_i_j: rotation (rad) before translation (m)."""


def write_g2o(path: Path, poses: NDArray[np.float64], edges: list[G2oEdge]) -> None:
    """Write vertices in space and their edges.

    The information in the file is that of (translation, rotation vector), as in gtsam.

    Args:
        path: path of the file.
        poses: (n, 4, 4) T_world_vertex, m.
        edges: relative poses between the vertices.
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
        path: path of the file.
        graph: a graph without priors and positions, for which the format has no usual tags.
        ids: (n,) numbers of the vertices in the file.

    Raises:
        ValueError: the graph has priors or positions.
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
    """Return the rows x y z qx qy qz qw of (n, 4, 4) poses."""
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat().reshape(-1, 4)
    return np.hstack([poses[:, :3, 3], quaternion])


def _of_poses(poses: Poses) -> _Array:
    """Return the rows x y z qx qy qz qw of poses; in the plane the rows x y angle."""
    numbers = numbers_of(poses)
    if isinstance(poses, jaxlie.SE3):
        return numbers[:, [4, 5, 6, 1, 2, 3, 0]]
    return np.column_stack([numbers[:, 2:], np.arctan2(numbers[:, 1], numbers[:, 0])])


def _triangle(information: _Array) -> _Array:
    """Return the upper triangles, in the order translation first, of matrices in the order rotation first."""
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


@dataclass(frozen=True)
class _Layout:
    """The format of a kind of pose."""

    vertex: str
    """Tag of a vertex's line."""
    edge: str
    """Tag of an edge's line."""
    pose_numbers: int
    """Count of the numbers of a pose."""
    size: int
    """Size of a tangent vector."""


SPACE = _Layout("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", 7, 6)
PLANE = _Layout("VERTEX_SE2", "EDGE_SE2", 3, 3)
_FIX = "FIX"


@dataclass(frozen=True)
class G2oFile:
    """The content of a g2o file."""

    graph: PoseGraph
    """The pose graph; its kinds of edge are odometry and loop."""
    ids: NDArray[np.int64]
    """(n,) numbers of the vertices in the file."""
    has_poses: bool
    """False if the file has edges only; the graph's poses are then the identity."""
    notes: tuple[str, ...]
    """Sentences on unusual content of the file, for the user."""


def read_g2o(path: Path) -> G2oFile:
    """Return the pose graph of a g2o file.

    Edges between vertices whose numbers are neighbours in sorted order count as odometry, others as loops.
    The information is that of (x, y, z, rotation vector), as in gtsam.

    Args:
        path: path of the file.

    Raises:
        LioJaxError: the file cannot be read as a pose graph; the message names the line.
    """
    lines = read_text(path, f"a g2o file holds lines such as {SPACE.edge}").splitlines()
    numbers: dict[str, list[int]] = {}
    for number, line in enumerate(lines):
        words = line.split(None, 1)
        if words and not words[0].startswith("#"):
            numbers.setdefault(words[0], []).append(number)
    layout = _layout(path, numbers)
    tags = (layout.vertex, layout.edge, _FIX)
    unknown = Counter({tag: len(at) for tag, at in numbers.items() if tag not in tags})
    notes = [
        f"{_counted(count, 'line')} of the unknown kind {tag} skipped (first: line {numbers[tag][0] + 1})."
        for tag, count in unknown.items()
    ]
    at_vertices, at_edges, at_fixes = (np.array(numbers.get(tag, []), np.int64) for tag in tags)
    columns, vertices = _table(path, lines, at_vertices, 1, layout.pose_numbers)
    triangle = layout.size * (layout.size + 1) // 2
    ends, edges = _table(path, lines, at_edges, 2, layout.pose_numbers + triangle)

    ids = columns[:, 0]
    if not len(ids):
        ids = np.unique(ends)
        notes.append("the file holds no vertices; the first guess is made from the edges.")
    _refuse_twice(path, ids, at_vertices)
    order = np.argsort(ids)
    ends = _index(path, ids, order, ends, at_edges)
    _refuse(path, at_edges, ends[:, 0] == ends[:, 1], "the edge joins a vertex to itself")
    notes += _duplicates(ends, at_edges)
    fixed = np.zeros(len(ids), bool)
    fixed_ids, at_fixed = _fixed(path, lines, at_fixes)
    fixed[_index(path, ids, order, fixed_ids[:, None], at_fixed).ravel()] = True

    rank = np.argsort(order)
    steps = rank[ends[:, 1]] - rank[ends[:, 0]]
    has_poses = bool(len(at_vertices))
    poses = vertices if has_poses else _identities(len(ids), layout)
    graph = PoseGraph(
        poses=_poses(path, poses, at_vertices),
        i=jax.device_put(ends[:, 0]),
        j=jax.device_put(ends[:, 1]),
        measurement=_poses(path, edges[:, : layout.pose_numbers], at_edges),
        information=jax.device_put(_information(path, edges[:, layout.pose_numbers :], layout, at_edges)),
        kind=jax.device_put(np.where(np.abs(steps) == 1, ODOMETRY, LOOP)),
        fixed=jax.device_put(fixed),
    )
    notes += _parts(ids, ends)
    return G2oFile(graph, ids, has_poses, tuple(notes))


def _layout(path: Path, numbers: dict[str, list[int]]) -> _Layout:
    there = [layout for layout in (SPACE, PLANE) if layout.vertex in numbers or layout.edge in numbers]
    if len(there) > 1:
        first = min(numbers.get(tag, [np.inf])[0] for tag in (PLANE.vertex, PLANE.edge)) + 1
        raise LioJaxError(f"{path}: line {first}: poses in the plane among poses in space; split the file.")
    if not numbers:
        raise LioJaxError(f"{path}: the file is empty; it needs lines such as {SPACE.edge} or {PLANE.edge}.")
    if not there or there[0].edge not in numbers:
        raise LioJaxError(f"{path}: no edges; the file needs lines such as {SPACE.edge} or {PLANE.edge}.")
    return there[0]


def _table(
    path: Path, lines: Sequence[str], at: NDArray[np.int64], whole: int, real: int
) -> tuple[NDArray[np.int64], _Array]:
    """Return the vertices' numbers and the real numbers of some lines; all lines are parsed at once."""
    words = " ".join([lines[number] for number in at.tolist()]).split()
    columns = 1 + whole + real
    if len(words) == len(at) * columns:
        table = np.array(words, object).reshape(len(at), columns)
        try:
            vertices, numbers = (
                table[:, 1 : 1 + whole].astype(np.int64),
                table[:, 1 + whole :].astype(np.float64),
            )
        except (ValueError, OverflowError):
            pass
        else:
            _refuse(path, at, ~np.isfinite(numbers).all(1), "a number is not finite")
            return vertices, numbers
    raise _unreadable_line(path, lines, at, whole, real)


def _unreadable_line(
    path: Path, lines: Sequence[str], at: NDArray[np.int64], whole: int, real: int
) -> LioJaxError:
    for number in at.tolist():
        tag, *words = lines[number].split()
        where = f"{path}: line {number + 1}"
        if len(words) != whole + real:
            return LioJaxError(f"{where}: {tag} needs {whole + real} numbers, not {len(words)}.")
        for place, word in enumerate(words):
            try:
                np.int64(int(word)) if place < whole else float(word)
            except (ValueError, OverflowError):
                noun = "vertex's number" if place < whole else "number"
                return LioJaxError(f"{where}: '{word}' is not a {noun}.")
    raise AssertionError("all lines can be read")


def _refuse(path: Path, at: NDArray[np.int64], wrong: ArrayLike, reason: str) -> None:
    if np.any(wrong):
        raise LioJaxError(f"{path}: line {at[np.argmax(wrong)] + 1}: {reason}.")


def _refuse_twice(path: Path, ids: NDArray[np.int64], at: NDArray[np.int64]) -> None:
    first = np.zeros(len(ids), bool)
    first[np.unique(ids, return_index=True)[1]] = True
    if not first.all():
        again = int(np.argmin(first))
        raise LioJaxError(f"{path}: line {at[again] + 1}: vertex {ids[again]} was there already.")


def _index(
    path: Path,
    ids: NDArray[np.int64],
    order: NDArray[np.int64],
    wanted: NDArray[np.int64],
    at: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return the index of the vertex with each wanted number."""
    found = order[np.minimum(np.searchsorted(ids, wanted, sorter=order), len(ids) - 1)]
    missing = ids[found] != wanted
    if np.any(missing):
        row, column = np.argwhere(missing)[0]
        raise LioJaxError(f"{path}: line {at[row] + 1}: there is no vertex {wanted[row, column]}.")
    return found


def _fixed(
    path: Path, lines: Sequence[str], at: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the numbers of the vertices that FIX lines name, one or several in a line, and their lines."""
    words = [(word, number) for number in at.tolist() for word in lines[number].split()[1:]]
    vertices = []
    for word, number in words:
        try:
            if not word.isdecimal():
                raise ValueError
            vertices.append(np.int64(int(word)))
        except (ValueError, OverflowError):
            raise LioJaxError(f"{path}: line {number + 1}: '{word}' is not a vertex's number.") from None
    return np.array(vertices, np.int64), np.array([at for _, at in words], np.int64)


def _identities(count: int, layout: _Layout) -> _Array:
    poses = np.zeros((count, layout.pose_numbers))
    if layout is SPACE:
        poses[:, -1] = 1
    return poses


def _poses(path: Path, numbers: _Array, at: NDArray[np.int64]) -> Poses:
    """Return the poses of rows (x, y, z, qx, qy, qz, qw) or (x, y, angle)."""
    if numbers.shape[1] == PLANE.pose_numbers:
        turn = np.stack([np.cos(numbers[:, 2]), np.sin(numbers[:, 2])], -1)
        return jaxlie.SE2(jax.device_put(np.concatenate([turn, numbers[:, :2]], -1)))
    with np.errstate(over="ignore"):  # an overflow gives an infinite length, which is refused
        length = np.linalg.norm(numbers[:, 3:], axis=1)
    _refuse(path, at, np.abs(length - 1) > 0.1, "the quaternion's length is not 1")
    wxyz = numbers[:, [6, 3, 4, 5]] / length[:, None]
    return jaxlie.SE3(jax.device_put(np.concatenate([wxyz, numbers[:, :3]], -1)))


def _information(path: Path, triangle: _Array, layout: _Layout, at: NDArray[np.int64]) -> _Array:
    """Return matrices in the order rotation first from upper triangles in the order translation first."""
    rows, columns = np.triu_indices(layout.size)
    matrix = np.zeros((len(triangle), layout.size, layout.size))
    matrix[:, rows, columns] = matrix[:, columns, rows] = triangle
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        wrong = np.linalg.eigvalsh(matrix)[:, 0] <= 0
        wrong[0] |= not wrong.any()
        _refuse(path, at, wrong, "the information matrix is not positive definite")
    return np.roll(matrix, 3 if layout is SPACE else 1, axis=(1, 2))


def _duplicates(ends: NDArray[np.int64], at: NDArray[np.int64]) -> list[str]:
    pairs = np.sort(ends, 1)
    _, first = np.unique(pairs, axis=0, return_index=True)
    again = np.setdiff1d(np.arange(len(pairs)), first)
    if not len(again):
        return []
    edges = _counted(len(again), "edge")
    first_line = at[again[0]] + 1
    return [
        f"{edges} between vertices that another edge joins already (first: line {first_line}); all count."
    ]


def _parts(ids: NDArray[np.int64], ends: NDArray[np.int64]) -> list[str]:
    part = parts_of(len(ids), ends[:, 0], ends[:, 1])
    _, first, sizes = np.unique(part, return_index=True, return_counts=True)
    if len(first) == 1:
        return []
    named = ", ".join(f"{ids[at]} ({size})" for at, size in zip(first[:5], sizes[:5], strict=True))
    more = ", ..." if len(first) > 5 else ""
    summary = f"the graph falls into {len(first)} parts that nothing joins; each is solved by itself"
    return [f"{summary}. Their first vertices (and sizes): {named}{more}."]


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count > 1)}"
