"""The run folder is never overwritten by accident."""

import json

import pytest

from lio_jax.core.errors import UsageError
from lio_jax.run.folder import prepare_folder, write_json


def test_makes_the_folder_and_its_parents(tmp_path):
    prepare_folder(tmp_path / "a" / "b", overwrite=False)
    assert (tmp_path / "a" / "b").is_dir()


def test_takes_an_empty_folder(tmp_path):
    prepare_folder(tmp_path, overwrite=False)


def test_refuses_a_folder_that_holds_something(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(UsageError, match=r"not empty; choose another folder or add --overwrite"):
        prepare_folder(tmp_path, overwrite=False)


def test_overwriting_removes_results_and_nothing_else(tmp_path):
    for name in ("thesis.tex", "trajectory.tum", "recording.rrd"):
        (tmp_path / name).touch()
    prepare_folder(tmp_path, overwrite=True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


def test_refuses_a_file_even_if_it_may_overwrite(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"file: is a file"):
        prepare_folder(tmp_path / "file", overwrite=True)


def test_folder_below_a_file_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"cannot be made \(Not a directory\)"):
        prepare_folder(tmp_path / "file" / "run", overwrite=False)


def test_json_holds_no_nan_and_leaves_no_half_file(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "metrics.json", {"ate": float("nan")})
    assert list(tmp_path.iterdir()) == []
    write_json(tmp_path / "metrics.json", {"ate": 0.1})
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"ate": 0.1}
