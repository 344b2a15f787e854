"""``lio-jax optimize-graph``."""

import json

import pytest

from tests.shared_data import SHARED_DATA, needs_shared

TRIANGLE = """\
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0.1
VERTEX_SE2 2 1 1 1.5
EDGE_SE2 0 1 1 0 1.57 100 0 0 100 0 100
EDGE_SE2 1 2 1 0 1.57 100 0 0 100 0 100
EDGE_SE2 2 0 1.05 0.98 -3.12 100 0 0 100 0 100
"""


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "in.g2o"
    path.write_text(TRIANGLE)
    return path


def test_json_is_one_object(cli, source, tmp_path):
    done = cli("optimize-graph", source, tmp_path / "out.g2o", "--json")
    assert (done.status, done.err) == (0, "")
    result = json.loads(done.out)
    assert list(result) == ["initial_cost", "final_cost", "iterations", "status", "solve_s"]
    assert result["status"] == "converged"
    assert 0 < result["final_cost"] < result["initial_cost"]
    again = json.loads(cli("optimize-graph", tmp_path / "out.g2o", tmp_path / "again.g2o", "--json").out)
    assert again["initial_cost"] == pytest.approx(result["final_cost"], rel=1e-9)
    assert again["final_cost"] == pytest.approx(result["final_cost"], rel=1e-9)


def test_table(cli, source, tmp_path):
    done = cli("optimize-graph", source, tmp_path / "out.g2o")
    assert (done.status, done.err) == (0, "")
    assert "3 vertices, 3 edges, 1 of them loops" in done.out
    assert "converged" in done.out
    assert "to compile" in done.out


def test_robust_names_the_loops_it_distrusts(cli, source, tmp_path):
    source.write_text(TRIANGLE + "EDGE_SE2 0 2 30 0 0 100 0 0 100 0 100\n")
    done = cli("optimize-graph", source, tmp_path / "out.g2o", "--robust", "--json")
    assert done.status == 0
    assert "note: 1 of 2 loops distrusted: 0-2." in done.err
    assert json.loads(done.out)["final_cost"] < 10


def test_notes_go_to_standard_error(cli, source, tmp_path):
    source.write_text("\n".join(line for line in TRIANGLE.splitlines() if line.startswith("EDGE")))
    done = cli("optimize-graph", source, tmp_path / "out.g2o", "--json")
    assert done.status == 0
    assert done.err.startswith(f"note: {source}: the file holds no vertices")
    result = json.loads(done.out)
    assert result["final_cost"] <= result["initial_cost"] < 1
    assert (tmp_path / "out.g2o").read_text().count("VERTEX_SE2") == 3


def test_a_mistake_in_the_file_is_one_sentence(cli, source, tmp_path):
    source.write_text(TRIANGLE.replace("EDGE_SE2 1 2", "EDGE_SE2 1 7"))
    done = cli("optimize-graph", source, tmp_path / "out.g2o")
    assert (done.status, done.out) == (1, "")
    assert done.err == f"lio-jax: {source}: line 5: there is no vertex 7.\n"
    assert not (tmp_path / "out.g2o").exists()


def test_a_missing_file_is_one_sentence(cli, tmp_path):
    done = cli("optimize-graph", tmp_path / "none.g2o", tmp_path / "out.g2o")
    assert done.status == 1
    assert "none.g2o: No such file or directory" in done.err


@pytest.mark.parametrize("out", ["in.g2o", ".", "none/out.g2o"])
def test_results_with_no_place_to_go_are_wrong_usage(cli, source, tmp_path, out):
    done = cli("optimize-graph", source, tmp_path / out)
    assert (done.status, done.out) == (2, "")
    assert str(tmp_path / out) in done.err
    assert source.read_text() == TRIANGLE


@needs_shared
def test_a_recorded_graph(cli, tmp_path):
    done = cli("optimize-graph", SHARED_DATA / "g2o" / "smallGrid3D.g2o", tmp_path / "out.g2o", "--json")
    assert done.status == 0
    assert json.loads(done.out)["final_cost"] == pytest.approx(517.9253, rel=1e-6)
