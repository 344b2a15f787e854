"""``lio-jax inspect`` and ``lio-jax eval``: tables for people, JSON and nothing else for programs."""

import json

import numpy as np
import pytest

from lio_jax.data.trajectory import Trajectory, write_tum
from lio_jax.settings.settings import load_settings
from tests.data import bags
from tests.run.small_drive import COUNT, bag_messages, moving, without_points, write_folder


def _line(path, offset=0.0, count=50):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count) * 0.5
    poses[:, 1, 3] = 2 * np.sin(np.arange(count) / 5)
    poses[::2, 2, 3] = offset
    write_tum(path, Trajectory(np.arange(count, dtype=np.int64) * 100_000_000, poses))
    return path


def test_eval_json(cli, tmp_path):
    done = cli("eval", _line(tmp_path / "a.tum", 0.2), _line(tmp_path / "b.tum"), "--json")
    assert (done.status, done.err) == (0, "")
    errors = json.loads(done.out)
    # z is off by 0 and 0.2 m in turn: 0.1 m each about their mean
    assert errors["ate"]["rmse"] == pytest.approx(0.1, abs=1e-3)
    assert errors["rpe"]["rmse"] == pytest.approx(0.2, abs=1e-6)
    assert errors["kitti"] is None


def test_eval_table(cli, tmp_path):
    done = cli("eval", _line(tmp_path / "a.tum", 0.2), _line(tmp_path / "b.tum"))
    assert done.status == 0
    assert "50 of 50 poses compared" in done.out
    assert "ATE translation" in done.out


@pytest.mark.parametrize(
    ("estimate", "reference", "message"),
    [
        ("nothing.tum", "b.tum", "nothing.tum: there is no such file or folder"),
        ("a.tum", "nothing.tum", "nothing.tum: there is no such file or folder"),
        ("a.tum", "words.txt", "words.txt: 3 numbers in its first line"),
        ("empty.txt", "b.tum", "empty.txt: holds no poses"),
        ("a.tum", "later.tum", "both must come from the same recording and clock"),
        ("a.tum", "recording", "recording: this recording holds no ground truth"),
    ],
)
def test_eval_of_what_cannot_be_compared(cli, tmp_path, estimate, reference, message):
    _line(tmp_path / "a.tum")
    _line(tmp_path / "b.tum")
    (tmp_path / "words.txt").write_text("not a trajectory\n")
    (tmp_path / "empty.txt").touch()
    (tmp_path / "later.tum").write_text("1000.0 0 0 0 0 0 0 1\n1001.0 0 0 0 0 0 0 1\n")
    write_folder(tmp_path / "recording", moving()[:1], with_truth=False)
    done = cli("eval", tmp_path / estimate, tmp_path / reference, "--json")
    assert (done.status, done.out) == (1, "")
    assert message in done.err
    assert done.err.count("\n") == 1


def test_inspect_json(folder, cli):
    done = cli("inspect", folder, "--json")
    assert (done.status, done.err) == (0, "")
    found = json.loads(done.out)
    assert found["format"] == "native"
    assert found["scans"] == COUNT
    assert found["rings"] == 16
    assert found["scan_rate"] == pytest.approx(10.0)
    assert found["calibration"] is True
    assert found["problems"] == []


def test_inspect_table_names_the_command_that_fits(folder, cli):
    done = cli("inspect", folder)
    assert done.status == 0
    assert f"Fits: lio-jax run {folder}" in done.out
    assert "none found" in done.out


def test_inspect_lists_what_is_wrong(cli, tmp_path):
    scans = list(moving())
    scans[3] = without_points(scans[3])
    data = write_folder(tmp_path / "data", scans)
    (data / "scans" / "000007.npz").unlink()
    done = cli("inspect", data, "--json")
    assert done.status == 0
    problems = " ".join(json.loads(done.out)["problems"])
    assert "scan(s) 000007 are missing" in problems
    assert "hold fewer than 1000 points (first: scan 3)" in problems


def test_inspect_takes_settings(cli, tmp_path):
    rows = bag_messages(moving()[:3], False, "/top") + bag_messages(moving()[:2], False, "/rear")
    bag = bags.write_bag(tmp_path / "a.bag", sorted(rows, key=lambda row: row[1]))
    assert json.loads(cli("inspect", bag, "--json").out)["scans"] == 3
    chosen = cli("inspect", bag, "--json", "--set", "config.data.lidar_topic=/rear")
    assert json.loads(chosen.out)["scans"] == 2


def test_inspect_of_nothing(cli, tmp_path):
    done = cli("inspect", tmp_path / "nothing", "--json")
    assert (done.status, done.out) == (1, "")
    assert done.err == f"lio-jax: {tmp_path / 'nothing'}: no such file or folder; check the path.\n"


def test_inspect_writes_settings_that_a_run_takes(cli, tmp_path):
    bag = bags.write_bag(tmp_path / "a.bag", bag_messages(moving()[:3], False))
    fits = tmp_path / "fits.yaml"
    assert cli("inspect", bag, "--write-config", fits).status == 0
    assert load_settings(fits).recipe == "default"
    again = cli("inspect", bag, "--write-config", fits)
    assert (again.status, again.out) == (2, "")
    assert f"{fits}: exists" in again.err
    assert cli("inspect", bag, "--write-config", fits, "--overwrite").status == 0
