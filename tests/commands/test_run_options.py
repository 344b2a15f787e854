"""Options of ``lio-jax run``: settings from files and words, parts of a recording, truth, output folder."""

import json
import sys
from io import StringIO

import pytest
import yaml

from lio_jax.cli import main
from lio_jax.data.trajectory import write_tum
from tests.commands.conftest import PLAIN
from tests.run.small_drive import COUNT, moving, truth, write_folder

FAST = (*PLAIN, "config.output.map=false")


def _values(out):
    return yaml.safe_load((out / "config.yaml").read_text())


def _stamps(out):
    return [line.split()[0] for line in (out / "trajectory.tum").read_text().splitlines()]


def test_assignments_may_stand_anywhere_and_be_many_and_the_last_wins(folder, cli, tmp_path):
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("recipe: default\nparams:\n  map: {voxel_size: 0.9}\n  lidar: {max_range: 60}\n")
    done = cli(
        *("run", "--set", "params.map.point_spacing=0.4", folder, "--scans", 2, "--recipe", recipe),
        *("--set", "params.registration.kernel=0.25", "config.registration.max_iterations=40"),
        *("--set", "params.map.point_spacing=0.3"),
        *("--out", tmp_path / "out", "--set=params.lidar.max_range=1e2", *FAST),
    )
    assert done.status == 0, done.err
    values = _values(tmp_path / "out")
    assert values["params"]["registration"]["kernel"] == 0.25
    assert values["config"]["registration"]["max_iterations"] == 40
    assert values["config"]["output"]["map"] is False
    # the later of two assignments, the file's own value, and an assignment over the file's
    assert values["params"]["map"]["point_spacing"] == 0.3
    assert values["params"]["map"]["voxel_size"] == 0.9
    assert values["params"]["lidar"]["max_range"] == 100.0


def test_a_data_folder_with_an_equals_sign_is_no_assignment(cli, tmp_path):
    data = write_folder(tmp_path / "speed=3", moving()[:2])
    done = cli("run", "--out", tmp_path / "out", *FAST, data)
    assert done.status == 0, done.err


def test_part_of_a_recording(folder, cli, tmp_path):
    done = cli("run", folder, "--start", 3, "--scans", 4, *FAST, "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert _stamps(tmp_path / "out") == [f"{s.end_ns // 10**9}.{s.end_ns % 10**9:09d}" for s in moving()[3:7]]


def test_more_scans_than_there_are_means_to_the_end(folder, cli, tmp_path):
    assert cli("run", folder, "--start", 9, "--scans", 99, *FAST, "--out", tmp_path / "out").status == 0
    assert len(_stamps(tmp_path / "out")) == COUNT - 9


@pytest.mark.parametrize("words", [("--scans", 0), ("--start", -1), ("--scans", "many")])
def test_impossible_part_of_a_recording(folder, cli, tmp_path, words):
    done = cli("run", folder, *words, "--out", tmp_path / "out")
    assert done.status == 2
    assert words[0] in done.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("start", [COUNT, 40])
def test_start_behind_the_end(folder, cli, tmp_path, start):
    done = cli("run", folder, "--start", start, *FAST, "--out", tmp_path / "out")
    assert done.status == 2
    assert done.err == (
        f"lio-jax: {folder}: holds {COUNT} scans, numbered from 0, so none from {start} on; "
        f"start at {COUNT - 1} or before.\n"
    )
    assert not (tmp_path / "out").exists()


def test_start_behind_the_end_spares_the_earlier_results(folder, cli, tmp_path):
    (tmp_path / "trajectory.tum").write_text("results of last week\n")
    done = cli("run", folder, "--start", 40, *FAST, "--out", tmp_path, "--overwrite")
    assert done.status == 2
    assert (tmp_path / "trajectory.tum").read_text() == "results of last week\n"


@pytest.mark.parametrize("kind", ["file", "run folder", "recording"])
def test_ground_truth_from_elsewhere(folder, cli, tmp_path, kind):
    data = write_folder(tmp_path / "data", moving()[:6], with_truth=False)
    given = {"file": tmp_path / "truth.tum", "run folder": tmp_path, "recording": folder}[kind]
    write_tum(tmp_path / "truth.tum", truth())
    write_tum(tmp_path / "trajectory.tum", truth())
    done = cli("run", data, "--gt", given, *FAST, "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["ate"]["rmse"] < 0.1


def test_without_truth_there_are_no_errors(cli, tmp_path):
    data = write_folder(tmp_path / "data", moving()[:3], with_truth=False)
    done = cli("run", data, *FAST, "--out", tmp_path / "out")
    assert done.status == 0
    assert "ATE" not in done.out
    assert "ate" not in json.loads((tmp_path / "out" / "metrics.json").read_text())


def test_ground_truth_that_is_not_there(folder, cli, tmp_path):
    done = cli("run", folder, "--gt", tmp_path / "nothing.tum", *FAST, "--out", tmp_path / "out")
    assert done.status == 1
    assert "nothing.tum: there is no such file or folder" in done.err
    assert not (tmp_path / "out").exists()


def test_ground_truth_without_stamps(folder, cli, tmp_path):
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    done = cli("run", folder, "--gt", tmp_path / "poses.txt", *FAST, "--out", tmp_path / "out")
    assert done.status == 2
    assert "poses.txt: has no time stamps; give a TUM file" in done.err


def test_ground_truth_of_another_day_is_a_warning(folder, cli, tmp_path):
    (tmp_path / "truth.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    done = cli("run", folder, "--scans", 2, "--gt", tmp_path / "truth.tum", *FAST, "--out", tmp_path / "out")
    assert done.status == 0
    assert "warning: no comparison with the truth: No pose of the estimate lies in the time span" in done.err


def test_broken_truth_of_the_recording(cli, tmp_path):
    data = write_folder(tmp_path / "data", moving()[:2])
    (data / "truth.tum").write_text("1.0 0 0 zero 0 0 0 1\n")
    done = cli("run", data, *FAST, "--out", tmp_path / "out")
    assert done.status == 1
    assert "truth.tum: line 1 is not 't x y z qx qy qz qw'" in done.err


def test_output_folder_that_exists_is_refused(folder, cli, tmp_path):
    (tmp_path / "trajectory.tum").write_text("results of last week\n")
    done = cli("run", folder, *FAST, "--out", tmp_path)
    assert done.status == 2
    assert done.err == (
        f"lio-jax: {tmp_path}: exists and is not empty; choose another folder or add --overwrite.\n"
    )
    assert (tmp_path / "trajectory.tum").read_text() == "results of last week\n"


def test_output_folder_is_overwritten_if_asked(folder, cli, tmp_path):
    for name in ("trajectory.tum", "map.pcd", "my_notes.txt"):
        (tmp_path / name).write_text("old")
    done = cli("run", folder, "--scans", 2, *FAST, "--out", tmp_path, "--overwrite")
    assert done.status == 0, done.err
    assert len(_stamps(tmp_path)) == 2
    # the new run wrote no map, and a stale one must not pass for its own
    assert not (tmp_path / "map.pcd").exists()
    assert (tmp_path / "my_notes.txt").read_text() == "old"


def test_output_folder_that_is_a_file(folder, cli, tmp_path):
    (tmp_path / "file").touch()
    done = cli("run", folder, "--out", tmp_path / "file")
    assert done.status == 2
    assert "file: is a file; give a folder" in done.err


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        (
            "config.map.capcity=65536",
            "--set: unknown key 'config.map.capcity'; did you mean 'config.map.capacity'?",
        ),
        ("params.map.voxelsize=1", "did you mean 'params.map.voxel_size'?"),
        ("voxel_size=1", "did you mean 'params.map.voxel_size'?"),
        ("params.map.voxel_size=big", "--set: params.map.voxel_size = 'big' must be a number."),
        ("params.map.voxel_size=-1", "--set: params.map.voxel_size = -1 must be greater than zero."),
        ("config.map.capacity=1000", "--set: config.map.capacity = 1000 must be a power of two."),
        ("params.map.voxel_size", "--set params.map.voxel_size: write it as path=value"),
        ("params.lidar.min_range=200", "params.lidar.min_range (200.0) must be below params.lidar.max_range"),
    ],
)
def test_wrong_assignment(folder, cli, tmp_path, assignment, message):
    done = cli("run", folder, "--out", tmp_path / "out", "--set", assignment)
    assert done.status == 2
    assert message in done.err
    assert done.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [("--set",), ("--set", "--scans", "2")])
def test_set_without_an_assignment(folder, cli, tmp_path, words):
    done = cli("run", folder, "--out", tmp_path / "out", *words)
    assert done.status == 2
    assert done.err.startswith("lio-jax: --set: nothing follows it")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "params: {map: {voxl_size: 1}}",
            "unknown key 'params.map.voxl_size'; did you mean 'params.map.voxel_size'?",
        ),
        ("params: {map: {voxel_size: none}}", "params.map.voxel_size = 'none' must be a number."),
        ("params: [1, 2", "not valid YAML"),
        ("just text", "expected keys 'recipe', 'config' and 'params'"),
        ("recipe: fast_lio3", "recipe 'fast_lio3' is not known; there are: default"),
    ],
)
def test_wrong_settings_file(folder, cli, tmp_path, text, message):
    recipe = tmp_path / "mine.yaml"
    recipe.write_text(text)
    done = cli("run", folder, "--out", tmp_path / "out", "--recipe", recipe)
    assert done.status == 2
    assert message in done.err
    assert "recipe" in text or "mine.yaml: " in done.err
    assert done.err.count("\n") == 1


def test_settings_file_that_is_not_there(folder, cli, tmp_path):
    done = cli("run", folder, "--out", tmp_path / "out", "--recipe", tmp_path / "mine.yaml")
    assert done.status == 2
    assert "mine.yaml: the settings file cannot be read" in done.err


def test_unknown_recipe(folder, cli, tmp_path):
    done = cli("run", folder, "--out", tmp_path / "out", "--recipe", "fast_lio3")
    assert done.status == 2
    assert "'fast_lio3' is not known; there are: default, fast_lio2, lio_sam, loam; or give" in done.err


def test_progress_on_a_terminal_only(folder, tmp_path, monkeypatch):
    class Terminal(StringIO):
        def isatty(self):
            return True

    class Pipe(StringIO):
        pass

    for stream, expected in ((Terminal(), True), (Pipe(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        out = tmp_path / type(stream).__name__
        assert main(["run", str(folder), "--out", str(out), *FAST]) == 0
        assert ("scan/s" in stream.getvalue()) is expected
        assert ("\r" in stream.getvalue()) is expected
