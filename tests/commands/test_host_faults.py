"""Faults of the machine in the middle of a run: one sentence names them, and what was computed stays."""

import shutil
from pathlib import Path

import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data import native
from lio_jax.data.trajectory import read_tum
from lio_jax.data.velodyne_file import read_returns
from tests.commands.conftest import PLAIN
from tests.full_disk import full_disk_after
from tests.run import small_drive

FORBIDDEN = Path("/sys/lio_jax")
"""A folder that nobody can make, the superuser included."""


def test_a_recording_that_is_lost_in_the_middle(cli, tmp_path, monkeypatch):
    data, out = small_drive.write_folder(tmp_path / "drive", small_drive.moving()), tmp_path / "out"
    whole = native.read_arrays

    def lose(path):
        # the run has begun: before that, the recording is read for its settings
        if path.name == "000005.npz" and (out / "unfinished.json").exists():
            shutil.move(data / "scans", tmp_path / "lost")
        return whole(path)

    monkeypatch.setattr(native, "read_arrays", lose)
    done = cli("run", data, *PLAIN, "--out", out)
    assert done.status == 1
    assert done.err.splitlines()[-1] == (
        f"lio-jax: {data / 'scans'}: is gone while it was read (No such file or directory); check the disk "
        f"or the network. The run ended early; the first 5 scans are in {out}."
    )
    assert len(read_tum(out / "trajectory.tum")) == 5
    # it goes on once the recording is back
    monkeypatch.undo()
    shutil.move(tmp_path / "lost", data / "scans")
    assert cli("run", data, *PLAIN, "--out", out, "--resume").status == 0
    assert len(read_tum(out / "trajectory.tum")) == small_drive.COUNT


def test_points_of_kitti_that_are_lost_are_no_single_scan_that_cannot_be_read(tmp_path):
    said: list[str] = []
    assert read_returns(tmp_path / "000000.bin", said.append) is None
    assert "the scan was skipped" in said[0]
    with pytest.raises(LioJaxError, match="is gone while it was read"):
        read_returns(tmp_path / "lost" / "000000.bin", said.append)


def test_a_disk_that_fills_up_is_the_cause_that_is_named(cli, folder, tmp_path):
    settings = ("--set", "config.output.plot=false", "config.output.recording=false")
    out = tmp_path / "out"
    with full_disk_after(6000):
        done = cli("run", folder, "--scans", 4, *settings, "--out", out)
    assert done.status == 1
    sentence = done.err.splitlines()[-1]
    assert sentence.startswith(f"lio-jax: {out}")
    assert sentence.endswith(": File too large; check the path, its permissions and the free space.")
    assert len(read_tum(out / "trajectory.tum")) > 0


@pytest.mark.skipif(
    not FORBIDDEN.parent.is_dir(), reason="no /sys here: no folder that refuses the superuser"
)
@pytest.mark.parametrize(
    "words",
    [
        ("run", "{data}", "--out", "{out}"),
        ("export", "{data}", "--to", "native", "--out", "{out}"),
    ],
)
def test_a_folder_that_takes_no_files(cli, folder, words):
    done = cli(*(word.format(data=folder, out=FORBIDDEN) for word in words))
    assert done.status in (1, 2)
    sentence = done.err.splitlines()[-1]
    assert sentence.startswith(f"lio-jax: {FORBIDDEN}: ")
    assert "Operation not permitted" in sentence or "Permission denied" in sentence
