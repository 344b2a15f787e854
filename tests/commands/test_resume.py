"""What ``lio-jax run --resume`` says and does in folders of every kind."""

import shutil

import pytest

from lio_jax.run import journal
from lio_jax.run.journal import Journal
from lio_jax.run.unfinished import MARK
from tests.commands.conftest import PLAIN
from tests.run.small_drive import COUNT

FILES = ("trajectory.tum", "trajectory_kitti.txt", "states.npz", "map.pcd", "keyframes.g2o", "config.yaml")


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory):
    """Return a finished run, and beside it the folder that it would have left if it had been killed."""
    from lio_jax.cli import main

    parent = tmp_path_factory.mktemp("runs")
    finish = Journal.remove

    def copying(self):
        shutil.copytree(parent / "whole", parent / "killed")
        finish(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(journal, "CHECKPOINT_EVERY_S", 0.0)
        patch.setattr(Journal, "remove", copying)
        assert main(["run", str(folder), *PLAIN, "--out", str(parent / "whole")]) == 0
    return parent / "whole"


@pytest.fixture
def killed(whole, tmp_path):
    """Return a folder whose run was killed before it ended; not even its metrics were written."""
    shutil.copytree(whole.parent / "killed", tmp_path / "out")
    (tmp_path / "out" / "metrics.json").unlink()
    return tmp_path / "out"


def same_files(one, other):
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in FILES)


def test_goes_on(folder, cli, whole, killed):
    done = cli("run", folder, *PLAIN, "--out", killed, "--resume")
    assert done.status == 0, done.err
    assert "note: the unfinished run goes on after its first" in done.err
    assert same_files(killed, whole)
    assert {entry.name for entry in killed.iterdir()} == {entry.name for entry in whole.iterdir()}


def test_goes_on_with_the_settings_of_the_killed_run(folder, cli, whole, killed):
    done = cli("run", folder, "--out", killed, "--resume")
    assert done.status == 0, done.err
    assert f"note: the settings are those of the unfinished run in {killed}." in done.err
    assert same_files(killed, whole)
    assert not (killed / "report.html").exists()


@pytest.mark.parametrize("exists", [True, False])
def test_an_empty_folder_is_simply_run_into(folder, cli, whole, tmp_path, exists):
    out = tmp_path / "out"
    if exists:
        out.mkdir()
    done = cli("run", folder, *PLAIN, "--out", out, "--resume")
    assert done.status == 0, done.err
    assert "unfinished" not in done.err
    assert same_files(out, whole)


def test_a_finished_run_is_left_alone(folder, cli, whole):
    before = {entry.name: entry.stat().st_mtime_ns for entry in whole.iterdir()}
    done = cli("run", folder, *PLAIN, "--out", whole, "--resume")
    assert done.status == 0
    assert done.err == f"{whole}: the run of {COUNT} scans is finished; there is nothing left to do.\n"
    assert {entry.name: entry.stat().st_mtime_ns for entry in whole.iterdir()} == before


def test_an_unfinished_run_is_not_lost_by_accident(folder, cli, killed):
    before = (killed / MARK).read_bytes()
    done = cli("run", folder, *PLAIN, "--out", killed)
    assert done.status == 2
    assert done.err.splitlines()[-1].startswith(f"lio-jax: {killed}: holds an unfinished run of ")
    assert done.err.splitlines()[-1].endswith(" scans; add --resume to go on or --overwrite to start anew.")
    assert (killed / MARK).read_bytes() == before


def test_overwriting_starts_anew(folder, cli, whole, killed):
    done = cli("run", folder, *PLAIN, "--out", killed, "--overwrite")
    assert done.status == 0, done.err
    assert "unfinished" not in done.err
    assert {entry.name for entry in killed.iterdir()} == {entry.name for entry in whole.iterdir()}


def test_changed_settings_are_named(folder, cli, killed):
    done = cli("run", folder, *PLAIN, "params.limits.speed=41", "--out", killed, "--resume")
    assert done.status == 2
    assert done.err.splitlines()[-1].startswith(
        f"lio-jax: {killed}: holds an unfinished run with other settings: params.limits.speed was "
    )
    done = cli("run", folder, *PLAIN, "--scans", 5, "--out", killed, "--resume")
    assert done.status == 2
    assert "other settings: --scans was None and is now 5; give the same ones with --resume" in done.err
    assert (killed / MARK).exists()


def test_both_options_are_one_too_many(folder, cli, killed):
    done = cli("run", folder, "--out", killed, "--resume", "--overwrite")
    assert done.status == 2
    assert "--resume goes on with the run in the folder and --overwrite replaces it; give one." in done.err


def test_a_folder_of_other_things_is_refused(folder, cli, tmp_path):
    (tmp_path / "thesis.tex").touch()
    done = cli("run", folder, "--out", tmp_path, "--resume")
    assert done.status == 2
    assert "exists and is not empty" in done.err


def test_a_damaged_mark(folder, cli, killed):
    (killed / MARK).write_text("{}{")
    done = cli("run", folder, *PLAIN, "--out", killed, "--resume")
    assert done.status == 2
    assert f"{killed / MARK}: cannot be read" in done.err
    assert "add --overwrite to start anew" in done.err


def test_a_report_of_an_unfinished_run_says_what_to_type(cli, killed):
    done = cli("report", killed)
    assert done.status == 1
    assert done.err == (
        f"lio-jax: {killed}: its run is unfinished, so there is no report yet; repeat the command of this "
        "run with --resume to go on (trajectory.tum holds the poses so far).\n"
    )
