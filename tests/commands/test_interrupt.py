"""Ctrl-C and faults in the middle: what was computed is written, whole."""

import json
import signal
import subprocess
import sys
import time
from itertools import cycle, islice

import numpy as np
import pytest
from pypcd4 import PointCloud

from lio_jax.commands import run as command
from lio_jax.core.errors import LioJaxError
from lio_jax.data.trajectory import read_tum
from lio_jax.run.unfinished import JOURNAL, MARK
from tests.commands.test_run_folder import FILES
from tests.run.small_drive import COUNT, PERIOD_NS, Replay, moving, shifted, standing, write_folder

SCANS = 1500
"""So many that they take seconds: an interrupt long after the first one still comes before the last."""


class Breaking(Replay):
    """A recording during whose replay something happens."""

    def __init__(self, after, error):
        super().__init__(moving())
        self.after, self.error = after, error

    def scans(self, start=0, count=None):
        yield from super().scans(0, self.after)
        raise self.error


def _files(folder):
    # a machine that compiles for longer than ten seconds leaves a checkpoint as well
    return {entry.name for entry in folder.iterdir()} - {JOURNAL}


def _check_complete(out, scans):
    from rerun.chunk import RrdReader

    assert _files(out) == FILES | {MARK}
    assert len(read_tum(out / "trajectory.tum")) == scans
    assert len(np.load(out / "states.npz")["poses"]) == scans
    assert PointCloud.from_path(out / "map.pcd").points > 1000
    assert json.loads((out / "metrics.json").read_text())["scans"] == scans
    logged = [
        c.num_rows for c in RrdReader(out / "recording.rrd").stream() if c.entity_path == "/world/lidar"
    ]
    # the last scan may have been interrupted between its result and its record
    assert scans - sum(logged) in (0, 1)


@pytest.mark.parametrize("scans", [1, 5])
def test_interrupted_while_reading(cli, tmp_path, monkeypatch, scans):
    monkeypatch.setattr(command, "open_sequence", lambda *_: Breaking(scans, KeyboardInterrupt()))
    done = cli("run", tmp_path, "--out", tmp_path / "out")
    assert done.status == 1
    assert done.err.splitlines()[-1] == (
        f"lio-jax: interrupted; the first {scans} scans are in {tmp_path / 'out'}; add --resume to go on."
    )
    _check_complete(tmp_path / "out", scans)


def test_interrupted_between_a_scan_and_its_record(cli, tmp_path, monkeypatch):
    def interrupt(self, result):
        if result.index == 3:
            raise KeyboardInterrupt
        original(self, result)

    original = command.RecordingSink.take
    monkeypatch.setattr(command.RecordingSink, "take", interrupt)
    monkeypatch.setattr(command, "open_sequence", lambda *_: Replay(moving()))
    done = cli("run", tmp_path, "--out", tmp_path / "out")
    assert done.status == 1
    assert "interrupted; the first 4 scans are in" in done.err
    assert _files(tmp_path / "out") == FILES | {MARK}


def test_interrupted_before_the_first_scan(cli, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "open_sequence", lambda *_: Breaking(0, KeyboardInterrupt()))
    done = cli("run", tmp_path, "--out", tmp_path / "out")
    assert done.status == 1
    assert done.err.splitlines()[-1] == "lio-jax: interrupted before the job was done."
    assert not (tmp_path / "out").exists()


def test_reader_that_fails_in_the_middle(cli, tmp_path, monkeypatch):
    error = LioJaxError("/mnt/stick/a.bag: the disk was pulled out.")
    monkeypatch.setattr(command, "open_sequence", lambda *_: Breaking(5, error))
    done = cli("run", tmp_path, "--out", tmp_path / "out")
    assert done.status == 1
    assert done.err.splitlines()[-1] == (
        "lio-jax: /mnt/stick/a.bag: the disk was pulled out. The run ended early; "
        f"the first 5 scans are in {tmp_path / 'out'}."
    )
    _check_complete(tmp_path / "out", 5)


def test_bug_in_the_middle(cli, tmp_path, monkeypatch):
    monkeypatch.setattr(
        command, "open_sequence", lambda *_: Breaking(5, ZeroDivisionError("division by zero"))
    )
    done = cli("run", tmp_path, "--out", tmp_path / "out")
    assert done.status == 1
    assert done.err.splitlines()[-1] == (
        "lio-jax: unexpected ZeroDivisionError: division by zero; run again with --debug and report it."
    )
    _check_complete(tmp_path / "out", 5)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_a_real_process(tmp_path, number):
    """Send it once the map's spool has begun to grow."""
    many = islice(cycle(standing()), SCANS)
    data = write_folder(
        tmp_path / "data",
        (shifted(scan, number // COUNT * COUNT * PERIOD_NS) for number, scan in enumerate(many)),
    )
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "lio_jax.cli", "run", str(data), "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a shell makes what it starts in the background ignore one of them, and nohup another
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    try:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and process.poll() is None:
            spool = list(out.glob(".map.*.spool")) if out.is_dir() else []
            if spool and spool[0].stat().st_size > 0:
                break
            time.sleep(0.01)
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 1, err
    assert "Traceback" not in err
    scans = len(read_tum(out / "trajectory.tum"))
    assert 0 < scans < SCANS
    assert err.splitlines()[-1] == (
        f"lio-jax: interrupted; the first {scans} scans are in {out}; add --resume to go on."
    )
    _check_complete(out, scans)
