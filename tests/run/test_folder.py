"""The run folder is never overwritten by accident."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.run.folder import RUN_FILES, run_folder, write_json
from lio_jax.run.keyframes import KeyframeWriter


def test_makes_the_folder_and_its_parents(tmp_path):
    with run_folder(tmp_path / "a" / "b", overwrite=False):
        (tmp_path / "a" / "b" / "trajectory.tum").touch()
    assert (tmp_path / "a" / "b" / "trajectory.tum").exists()


def test_takes_an_empty_folder_and_leaves_it_there(tmp_path):
    with run_folder(tmp_path, overwrite=False):
        pass
    assert tmp_path.is_dir()


def fail_in(folder):
    with run_folder(folder, overwrite=False):
        assert folder.is_dir()
        raise KeyboardInterrupt


def test_a_folder_that_got_no_results_is_removed(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        fail_in(tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_refuses_a_folder_that_holds_something(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with (
        pytest.raises(UsageError, match=r"not empty; choose another folder or add --overwrite"),
        run_folder(tmp_path, overwrite=False),
    ):
        pass
    assert (tmp_path / "thesis.tex").exists()


def test_overwriting_removes_results_and_nothing_else(tmp_path):
    for name in ("thesis.tex", "trajectory.tum", "recording.rrd"):
        (tmp_path / name).touch()
    with run_folder(tmp_path, overwrite=True):
        assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


def with_keyframes(folder, finished):
    writer = KeyframeWriter(folder)
    writer.append(np.zeros((4, 3), np.float32))
    if finished:
        writer.finish(np.zeros(1, np.int64), np.eye(4)[None], np.eye(4)[None])
    (folder / "keyframes" / ".000001.0123abcd.npz").touch()


def test_keyframes_of_a_run_that_ended_are_removed_by_overwriting_only(tmp_path):
    with_keyframes(tmp_path, finished=True)
    with pytest.raises(UsageError, match=r"not empty"), run_folder(tmp_path, overwrite=False):
        pass
    assert (tmp_path / "keyframes" / "000000.npz").exists()
    with run_folder(tmp_path, overwrite=True):
        assert list(tmp_path.iterdir()) == []


def test_keyframes_of_a_killed_run_are_nobody_s(tmp_path):
    with_keyframes(tmp_path, finished=False)
    with run_folder(tmp_path, overwrite=False):
        assert list(tmp_path.iterdir()) == []


def test_what_others_put_among_the_keyframes_stays(tmp_path):
    with_keyframes(tmp_path, finished=True)
    (tmp_path / "keyframes" / "labels.npz").touch()
    with run_folder(tmp_path, overwrite=True):
        assert [entry.name for entry in (tmp_path / "keyframes").iterdir()] == ["labels.npz"]


def test_refuses_a_file_even_if_it_may_overwrite(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"file: is a file"), run_folder(tmp_path / "file", overwrite=True):
        pass


def test_folder_below_a_file_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with (
        pytest.raises(UsageError, match=r"cannot be made \(Not a directory\)"),
        run_folder(tmp_path / "file" / "run", overwrite=False),
    ):
        pass


def test_refuses_a_folder_that_another_run_holds(tmp_path):
    with run_folder(tmp_path, overwrite=False):
        (tmp_path / ".map.0123abcd.pcd").touch()
        with pytest.raises(UsageError, match=r"another run is writing there"), run_folder(tmp_path, True):
            pass
        assert (tmp_path / ".map.0123abcd.pcd").exists()


WRITES_AND_IS_KILLED = """
import os, signal, sys
from pathlib import Path
import numpy as np
from lio_jax.core.files import atomic_path
from lio_jax.run.folder import RUN_FILES, run_folder
from lio_jax.run.map_file import MapFile

out = Path(sys.argv[1])
with run_folder(out, False):
    MapFile(out / "map.pcd").append(np.zeros((1000, 3), np.float32))
    for name in RUN_FILES:
        atomic_path(out / name).__enter__().write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_run_left_behind_is_removed(tmp_path):
    out = tmp_path / "out"
    killed = subprocess.run([sys.executable, "-c", WRITES_AND_IS_KILLED, out], timeout=60)
    assert killed.returncode == -signal.SIGKILL
    left = sorted(entry.name for entry in out.iterdir())
    assert len(left) == len(RUN_FILES) + 1
    assert all(name.startswith(".") for name in left)
    with run_folder(out, overwrite=False):
        assert list(out.iterdir()) == []


def test_other_hidden_files_are_nobody_s_leftovers(tmp_path):
    for name in (".git", ".map.pcd", ".map.0123abcg.pcd", ".map.0123abcd.npz", ".trajectory.old.tum"):
        (tmp_path / name).touch()
    with run_folder(tmp_path, overwrite=True):
        assert len(list(tmp_path.iterdir())) == 5


def test_json_holds_no_nan_and_leaves_no_half_file(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "metrics.json", {"ate": float("nan")})
    assert list(tmp_path.iterdir()) == []
    write_json(tmp_path / "metrics.json", {"ate": 0.1})
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"ate": 0.1}
