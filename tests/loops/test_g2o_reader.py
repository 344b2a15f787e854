"""g2o files of other programs: what they hold, and what is wrong with them."""

import jaxlie
import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.pose_graph.g2o import read_g2o, write_graph
from lio_jax.pose_graph.graph import LOOP, ODOMETRY, numbers_of
from lio_jax.pose_graph.pose_graph import solve
from tests.shared_data import SHARED_DATA, needs_shared

SPACE = "1 2 3 0 0 0 1"
PLANE = "1 2 0.5"
WEIGHTS = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
PLANE_WEIGHTS = "1 0 0 1 0 1"
VERTICES = [f"VERTEX_SE2 {number} {PLANE}" for number in range(3)]
EDGES = [f"EDGE_SE2 {number} {number + 1} {PLANE} {PLANE_WEIGHTS}" for number in range(2)]


@pytest.fixture
def read(tmp_path):
    """Return a function that reads a file of the given lines."""

    def read_lines(*lines):
        path = tmp_path / "graph.g2o"
        path.write_text("\n".join(lines) + "\n")
        return read_g2o(path)

    return read_lines


def test_plane(read):
    file = read(*VERTICES, "FIX 1", *EDGES, "EDGE_SE2 2 0 0.1 0.2 -3 1 2 3 14 5 60")
    assert file.ids.tolist() == [0, 1, 2]
    assert file.has_poses
    assert file.notes == ()
    graph = file.graph
    assert isinstance(graph.poses, jaxlie.SE2)
    np.testing.assert_allclose(numbers_of(graph.poses)[0], [np.cos(0.5), np.sin(0.5), 1, 2])
    np.testing.assert_allclose(numbers_of(graph.measurement)[2], [np.cos(3), -np.sin(3), 0.1, 0.2])
    assert graph.i.tolist() == [0, 1, 2]
    assert graph.j.tolist() == [1, 2, 0]
    assert graph.kind.tolist() == [ODOMETRY, ODOMETRY, LOOP]
    assert graph.fixed.tolist() == [False, True, False]
    # the file counts (x, y, angle)
    np.testing.assert_array_equal(graph.information[2], [[60, 3, 5], [3, 1, 2], [5, 2, 14]])


def test_space(read):
    upper = np.triu(np.arange(36.0).reshape(6, 6) / 100) + 9 * np.eye(6)
    numbers = " ".join(str(value) for value in upper[np.triu_indices(6)])
    file = read(
        f"VERTEX_SE3:QUAT 7 {SPACE}",
        "VERTEX_SE3:QUAT 5 4 5 6 0.6 0 0 0.8",
        f"EDGE_SE3:QUAT 5 7 4 5 6 0 0.6 0 -0.8 {numbers}",
    )
    graph = file.graph
    assert file.ids.tolist() == [7, 5]
    assert (graph.i.tolist(), graph.j.tolist()) == ([1], [0])
    assert graph.kind.tolist() == [ODOMETRY]
    np.testing.assert_allclose(numbers_of(graph.poses)[1], [0.8, 0.6, 0, 0, 4, 5, 6])
    np.testing.assert_allclose(numbers_of(graph.measurement)[0], [-0.8, 0, 0.6, 0, 4, 5, 6])
    full = upper + np.triu(upper, 1).T
    np.testing.assert_allclose(graph.information[0][:3, :3], full[3:, 3:])
    np.testing.assert_allclose(graph.information[0][:3, 3:], full[3:, :3])
    np.testing.assert_allclose(graph.information[0][3:, 3:], full[:3, :3])


def test_edges_alone(read):
    file = read(*EDGES)
    assert not file.has_poses
    assert file.ids.tolist() == [0, 1, 2]
    assert file.notes == ("the file holds no vertices; the first guess is made from the edges.",)
    assert float(solve(file.graph).cost) < 1e-15


def test_comments_blank_lines_and_windows_line_ends(read):
    file = read("# a comment", "", VERTICES[0] + "\r", "  " + VERTICES[1], EDGES[0], "\t")
    assert len(file.ids) == 2
    assert file.notes == ()


def test_numbers_of_vertices_may_be_large_and_unordered(read):
    large = [7318349394477056002, 3, 7318349394477056001]
    file = read(
        *[f"VERTEX_SE2 {number} {PLANE}" for number in large],
        f"EDGE_SE2 {large[2]} {large[0]} {PLANE} {PLANE_WEIGHTS}",
        f"EDGE_SE2 3 {large[0]} {PLANE} {PLANE_WEIGHTS}",
    )
    assert file.ids.tolist() == large
    assert file.graph.i.tolist() == [2, 1]
    assert file.graph.j.tolist() == [0, 0]


def test_unknown_kinds_are_counted(read):
    file = read("PARAMS_SE3OFFSET 0 1", *VERTICES, *EDGES, "EDGE_SE2_XY 0 1 2", "EDGE_SE2_XY 0 2 2")
    assert file.notes == (
        "1 line of the unknown kind PARAMS_SE3OFFSET skipped (first: line 1).",
        "2 lines of the unknown kind EDGE_SE2_XY skipped (first: line 7).",
    )


def test_duplicate_edges_are_reported_and_used(read):
    file = read(*VERTICES, *EDGES, EDGES[0])
    assert file.notes == (
        "1 edge between vertices that another edge joins already (first: line 6); all count.",
    )
    assert len(file.graph.i) == 3


def test_the_parts_of_a_graph_are_reported(read):
    file = read(
        *VERTICES,
        f"VERTEX_SE2 8 {PLANE}",
        f"VERTEX_SE2 9 {PLANE}",
        EDGES[0],
        EDGES[1],
        f"EDGE_SE2 8 9 {PLANE} {PLANE_WEIGHTS}",
    )
    said = "the graph falls into 2 parts that nothing joins; each is solved by itself"
    assert file.notes == (f"{said}. Their first vertices (and sizes): 0 (3), 8 (2).",)


MISTAKES = {
    "an edge to a missing vertex": (
        [*VERTICES, EDGES[0], f"EDGE_SE2 1 9 {PLANE} {PLANE_WEIGHTS}"],
        "line 5: there is no vertex 9.",
    ),
    "a missing fixed vertex": ([*VERTICES, *EDGES, "FIX 0", "FIX 1 4"], "line 7: there is no vertex 4."),
    "a fixed word": ([*VERTICES, *EDGES, "FIX first"], "line 6: 'first' is not a vertex's number."),
    "a vertex twice": ([*VERTICES, VERTICES[1], *EDGES], "line 4: vertex 1 was there already."),
    "a self loop": (
        [*VERTICES, *EDGES, f"EDGE_SE2 2 2 {PLANE} {PLANE_WEIGHTS}"],
        "line 6: the edge joins a vertex to itself.",
    ),
    "negative information": (
        [*VERTICES, EDGES[0], f"EDGE_SE2 1 2 {PLANE} 1 0 0 -1 0 1"],
        "line 5: the information matrix is not positive definite.",
    ),
    "singular information": (
        [*VERTICES, EDGES[0], f"EDGE_SE2 1 2 {PLANE} 1 1 0 1 0 1"],
        "line 5: the information matrix is not positive definite.",
    ),
    "a word for a number": (
        [*VERTICES, f"EDGE_SE2 0 1 1 two 3 {PLANE_WEIGHTS}"],
        "line 4: 'two' is not a number.",
    ),
    "a number that is not finite": (
        [*VERTICES, f"EDGE_SE2 0 1 1 nan 3 {PLANE_WEIGHTS}"],
        "line 4: a number is not finite.",
    ),
    "half a vertex's number": (
        [*VERTICES, f"EDGE_SE2 0 1.5 {PLANE} {PLANE_WEIGHTS}"],
        "line 4: '1.5' is not a vertex's number.",
    ),
    "too few numbers": (
        [*VERTICES, "EDGE_SE2 0 1 1 2 3 1 0 0 1 0"],
        "line 4: EDGE_SE2 needs 11 numbers, not 10.",
    ),
    "numbers moved between lines": (
        [*VERTICES, EDGES[0] + " 1", EDGES[1][:-2]],
        "line 4: EDGE_SE2 needs 11 numbers, not 12.",
    ),
    "no edges": (VERTICES, "no edges; the file needs lines such as EDGE_SE3:QUAT or EDGE_SE2."),
    "nothing": ([], "the file is empty; it needs lines such as EDGE_SE3:QUAT or EDGE_SE2."),
    "plane and space": (
        [*VERTICES, *EDGES, f"VERTEX_SE3:QUAT 5 {SPACE}"],
        "line 1: poses in the plane among poses in space; split the file.",
    ),
    "a quaternion that is none": (
        [
            "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0",
            f"EDGE_SE3:QUAT 0 1 {SPACE} {WEIGHTS}",
            f"VERTEX_SE3:QUAT 1 {SPACE}",
        ],
        "line 1: the quaternion's length is not 1.",
    ),
    "a quaternion whose length overflows": (
        [
            "VERTEX_SE3:QUAT 0 0 0 0 0 1e300 0 1",
            f"EDGE_SE3:QUAT 0 1 {SPACE} {WEIGHTS}",
            f"VERTEX_SE3:QUAT 1 {SPACE}",
        ],
        "line 1: the quaternion's length is not 1.",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_one_sentence_that_names_the_line(read, tmp_path, mistake):
    lines, sentence = MISTAKES[mistake]
    with pytest.raises(LioJaxError) as refused:
        read(*lines)
    assert str(refused.value) == f"{tmp_path / 'graph.g2o'}: {sentence}"


def test_a_file_that_is_not_text_is_an_error(tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(LioJaxError, match="not a text file"):
        read_g2o(path)


@needs_shared
@pytest.mark.parametrize("name", ["smallGrid3D", "intel"])
def test_a_recorded_graph_is_written_as_it_was_read(tmp_path, name):
    file = read_g2o(SHARED_DATA / "g2o" / f"{name}.g2o")
    write_graph(tmp_path / "copy.g2o", file.graph, file.ids)
    again = read_g2o(tmp_path / "copy.g2o")
    assert again.ids.tolist() == file.ids.tolist()
    for leaf in ("i", "j", "kind", "fixed"):
        np.testing.assert_array_equal(getattr(again.graph, leaf), getattr(file.graph, leaf))
    np.testing.assert_allclose(numbers_of(again.graph.poses), numbers_of(file.graph.poses), atol=1e-12)
    np.testing.assert_allclose(again.graph.information, file.graph.information, rtol=1e-13)
    cost, expected = float(solve(again.graph).cost), float(solve(file.graph).cost)
    assert cost == pytest.approx(expected, rel=1e-9)
