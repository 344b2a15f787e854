"""Pose graphs in g2o's text format, against the format's own definition and a recorded graph."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.pose_graph.g2o import G2oEdge, write_g2o
from tests.shared_data import SHARED_DATA, needs_shared


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
    pose[:3, 3] = rng.normal(0, 100, 3)
    return pose


def random_information(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return root @ root.T * 1e4


def pose_of(numbers: list[float]) -> np.ndarray:
    """Return the matrix of x y z qx qy qz qw."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(numbers[3:7]).as_matrix()
    pose[:3, 3] = numbers[:3]
    return pose


def information_of(numbers: list[float]) -> np.ndarray:
    """Return the 6x6 matrix whose upper triangle is stored row by row, translation first."""
    matrix = np.zeros((6, 6))
    position = 0
    for row in range(6):
        for column in range(row, 6):
            matrix[row, column] = matrix[column, row] = numbers[position]
            position += 1
    return matrix


def read(text: str) -> tuple[dict, list]:
    """Return vertices by number and edges (i, j, pose, information), as the format is documented."""
    vertices, edges = {}, []
    for line in text.splitlines():
        kind, *fields = line.split()
        if kind == "VERTEX_SE3:QUAT":
            assert len(fields) == 8
            vertices[int(fields[0])] = pose_of([float(f) for f in fields[1:]])
        else:
            assert kind == "EDGE_SE3:QUAT"
            assert len(fields) == 2 + 7 + 21
            numbers = [float(f) for f in fields[2:]]
            edges.append((int(fields[0]), int(fields[1]), pose_of(numbers[:7]), information_of(numbers[7:])))
    return vertices, edges


@pytest.fixture
def graph() -> tuple[np.ndarray, list[G2oEdge]]:
    poses = np.stack([random_pose(seed) for seed in range(4)])
    pairs = [(0, 1), (1, 2), (2, 3), (0, 3)]
    edges = [
        G2oEdge(i, j, np.linalg.inv(poses[i]) @ poses[j], random_information(10 * i + j)) for i, j in pairs
    ]
    return poses, edges


def test_what_was_written_is_read_back(tmp_path, graph):
    poses, edges = graph
    write_g2o(tmp_path / "graph.g2o", poses, edges)
    vertices, found = read((tmp_path / "graph.g2o").read_text())
    assert list(vertices) == [0, 1, 2, 3]
    for number, pose in vertices.items():
        np.testing.assert_allclose(pose, poses[number], atol=1e-9)
    assert [(i, j) for i, j, _, _ in found] == [(edge.i, edge.j) for edge in edges]
    for (_, _, pose, information), edge in zip(found, edges, strict=True):
        np.testing.assert_allclose(pose, edge.T_i_j, atol=1e-9)
        # the file holds translation before rotation
        swapped = np.block(
            [[information[3:, 3:], information[3:, :3]], [information[:3, 3:], information[:3, :3]]]
        )
        np.testing.assert_allclose(swapped, edge.information, rtol=1e-8, atol=1e-3)


def test_translation_weights_come_first(tmp_path):
    information = np.diag([4.0, 5.0, 6.0, 1.0, 2.0, 3.0])
    write_g2o(tmp_path / "graph.g2o", np.stack([np.eye(4)] * 2), [G2oEdge(0, 1, np.eye(4), information)])
    fields = (tmp_path / "graph.g2o").read_text().splitlines()[-1].split()
    upper = [float(f) for f in fields[10:]]
    diagonal = [upper[k] for k in (0, 6, 11, 15, 18, 20)]
    assert diagonal == [1, 2, 3, 4, 5, 6]
    assert sum(upper) == sum(diagonal)


def test_a_consistent_graph_has_no_residual(tmp_path, graph):
    write_g2o(tmp_path / "graph.g2o", *graph)
    vertices, edges = read((tmp_path / "graph.g2o").read_text())
    for i, j, T_i_j, _ in edges:
        np.testing.assert_allclose(np.linalg.inv(vertices[i]) @ vertices[j], T_i_j, atol=1e-8)


def test_one_pose_and_no_edge(tmp_path):
    write_g2o(tmp_path / "graph.g2o", np.eye(4)[None], [])
    assert (tmp_path / "graph.g2o").read_text() == "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"


def test_numbers_keep_their_digits(tmp_path):
    pose = random_pose(0)
    pose[:3, 3] = [123456.789012, -1e-7, 3.0]
    write_g2o(tmp_path / "graph.g2o", pose[None], [])
    vertices, _ = read((tmp_path / "graph.g2o").read_text())
    np.testing.assert_allclose(vertices[0], pose, rtol=1e-11, atol=1e-11)


def test_no_temporary_file_is_left(tmp_path, graph):
    write_g2o(tmp_path / "graph.g2o", *graph)
    assert [path.name for path in tmp_path.iterdir()] == ["graph.g2o"]


@needs_shared
def test_a_recorded_graph_survives(tmp_path):
    """A part of sphere2500, read by the format's definition and written again."""
    source = next((SHARED_DATA / "g2o").rglob("sphere2500*.g2o"))
    text = source.read_text()
    kept = [line for line in text.splitlines() if line.startswith(("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"))]
    vertices, edges = read("\n".join(kept))
    swap = [3, 4, 5, 0, 1, 2]
    count = 100
    poses = np.stack([vertices[number] for number in range(count)])
    part = [
        G2oEdge(i, j, pose, information[np.ix_(swap, swap)])
        for i, j, pose, information in edges
        if max(i, j) < count
    ]
    assert len(part) >= count - 1
    write_g2o(tmp_path / "graph.g2o", poses, part)
    again, found = read((tmp_path / "graph.g2o").read_text())
    for number, pose in again.items():
        np.testing.assert_allclose(pose, vertices[number], atol=1e-8)
    originals = [edge for edge in edges if max(edge[:2]) < count]
    for one, other in zip(found, originals, strict=True):
        assert one[:2] == other[:2]
        np.testing.assert_allclose(one[2], other[2], atol=1e-8)
        np.testing.assert_allclose(one[3], other[3], rtol=1e-7)
