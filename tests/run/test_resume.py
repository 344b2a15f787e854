"""A run whose process is killed goes on, and ends with the files of a run that was never killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import read_arrays
from lio_jax.data import write_native
from lio_jax.data.trajectory import read_tum
from lio_jax.run import journal as journal_module
from lio_jax.run.folder import run_folder
from lio_jax.run.journal import opened_journal
from lio_jax.run.record import Record, read_record
from lio_jax.run.run import run_sequence, settings_for
from lio_jax.run.sinks import Sink
from lio_jax.run.unfinished import JOURNAL, MARK, read_unfinished
from lio_jax.settings.settings import recipe_settings, with_overrides
from tests.commands.conftest import PLAIN
from tests.run import inertial_drive, small_drive
from tests.run.inertial_drive import InertialReplay
from tests.run.small_drive import COUNT, Replay, moving

_TIMED = {"decode_ms", "pad_ms", "step_ms", "record_ms", "total_ms"}
_OF_TIMES = {"metrics.json", "recording.rrd", "report.html", "timings.png"}
"""Files that hold times too, or are drawn from them."""
_TIMES = {"scan_ms", "compile_s", "wall_s", "peak_rss_mb", "resumed_at_scan"}


@pytest.fixture(autouse=True)
def often(monkeypatch):
    """Let every scan have a checkpoint."""
    monkeypatch.setattr(journal_module, "CHECKPOINT_EVERY_S", 0.0)
    monkeypatch.setattr(journal_module, "POSES_AT_ONCE", 1)


def contents(folder):
    """Return everything in a run folder that two equal runs have in common, by name."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".npz":
            arrays = read_arrays(path)
            found |= {f"{name} {key}": arrays[key].tobytes() for key in arrays.keys() - _TIMED}
        elif path.is_file() and name not in _OF_TIMES:
            found[name] = path.read_bytes()
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics.get("backend", {}).pop("busy_s", None)
    return found | {f"metrics {key}": value for key, value in metrics.items() if key not in _TIMES}


class Copying(Sink):
    """Copies the run folder at some scans, as a process that is killed there would leave it."""

    def __init__(self, folder, into, at):
        self.folder, self.into, self.at = folder, into, at

    def take(self, result):
        if result.index in self.at:
            self._wait_for(result.index + 1)
            shutil.copytree(self.folder, self.into / str(result.index))

    def _wait_for(self, scans):
        """Wait for the writing thread: a copy, other than a kill, takes its files one after the other."""
        deadline = time.monotonic() + 0.5
        while read_unfinished(self.folder).scans < scans and time.monotonic() < deadline:
            time.sleep(0.005)


class Seeing(Sink):
    def __init__(self):
        self.indices, self.kept = [], []

    def take(self, result):
        self.indices.append(result.index)
        self.kept.append(np.array(result.output.points).tobytes() + result.raw.tobytes())


def resumable(recording, settings, out, sinks=(), notify=None, **part):
    """Run with a journal, as the command line does."""
    with (
        run_folder(out, overwrite=False, resume=True),
        opened_journal(out, recording, settings, notify=notify, **part) as journal,
    ):
        result = run_sequence(recording, settings, out, sinks=sinks, journal=journal, **part)
        if result.interruption is None:
            journal.remove()
    return result


def killed_at(recording, settings, folder, at):
    """Return the folders that a run leaves if it is killed at these scans, and the whole run's contents."""
    resumable(recording, settings, folder / "whole", [Copying(folder / "whole", folder, at)])
    return [folder / str(index) for index in at], contents(folder / "whole")


def test_without_a_kill_nothing_is_different(tmp_path, settings):
    resumable(Replay(moving()), settings, tmp_path / "one")
    run_sequence(Replay(moving()), settings, tmp_path / "other")
    assert contents(tmp_path / "one") == contents(tmp_path / "other")


def test_lidar_alone(tmp_path, settings):
    folders, whole = killed_at(Replay(moving()), settings, tmp_path, (0, 1, 2, 5, COUNT - 1))
    for folder in folders:
        resumable(Replay(moving()), settings, folder)
        assert contents(folder) == whole


def test_with_inertial_samples_an_outage_and_scans_without_points(tmp_path, inertial_settings):
    scans = inertial_drive.scans()
    # the run begins with a scan that shows nothing, some are lost in the middle, some were never recorded
    for number in (0, 11, 12):
        scans[number] = small_drive.without_points(scans[number])
    scans = scans[:17] + scans[24:]
    recording = InertialReplay(scans, inertial_drive.imu())
    folders, whole = killed_at(recording, inertial_settings, tmp_path, (0, 12, 18))
    assert len(whole["metrics failures"]) > 2
    for folder in folders:
        resumable(recording, inertial_settings, folder)
        assert contents(folder) == whole


def test_with_a_back_end(tmp_path, inertial_settings):
    recording = InertialReplay(inertial_drive.scans(), inertial_drive.imu())
    loops = with_overrides(
        inertial_settings, ["config.backend.loops=true", "config.output.keyframe_distance=0.3"]
    )
    folders, whole = killed_at(recording, loops, tmp_path, (9, 25))
    assert {"loops.json", "odometry.tum", "keyframes/000002.npz points"} <= whole.keys()
    for folder in folders:
        resumable(recording, loops, folder)
        assert contents(folder) == whole


@pytest.mark.long
def test_lio_sam(tmp_path):
    recording = InertialReplay(inertial_drive.scans(), inertial_drive.imu())
    settings, _ = settings_for(recording, recipe_settings("lio_sam"))
    folders, whole = killed_at(recording, settings, tmp_path, (4, 20))
    for folder in folders:
        resumable(recording, settings, folder)
        assert contents(folder) == whole


def test_a_part_of_a_recording_killed_twice(tmp_path, settings):
    part = {"start": 2, "count": 8}
    resumable(Replay(moving()), settings, tmp_path / "whole", **part)
    once = [Copying(tmp_path / "once", tmp_path, (3,))]
    resumable(Replay(moving()), settings, tmp_path / "once", once, **part)
    twice = [Copying(tmp_path / "3", tmp_path, (6,))]
    resumable(Replay(moving()), settings, tmp_path / "3", twice, **part)
    result = resumable(Replay(moving()), settings, tmp_path / "6", **part)
    assert 2 < result.metrics["resumed_at_scan"] <= 9
    assert contents(tmp_path / "6") == contents(tmp_path / "whole") == contents(tmp_path / "3")


def test_a_kill_while_the_stored_steps_are_read_loses_none(tmp_path, settings):
    [folder], whole = killed_at(Replay(moving()), settings, tmp_path, (8,))
    kept = read_unfinished(folder).scans
    assert kept > 1
    resumable(Replay(moving()), settings, folder, [Copying(folder, tmp_path / "again", (2,))])
    again = tmp_path / "again" / "2"
    assert read_unfinished(again).scans == kept
    result = resumable(Replay(moving()), settings, again)
    assert result.metrics["resumed_at_scan"] == kept
    assert contents(again) == whole


def test_an_interrupted_run_goes_on(tmp_path, settings):
    class Stopping(Sink):
        def take(self, result):
            if result.index == 7:
                raise KeyboardInterrupt

    resumable(Replay(moving()), settings, tmp_path / "whole")
    resumable(Replay(moving()), settings, tmp_path / "out", [Stopping()])
    assert len(read_tum(tmp_path / "out" / "trajectory.tum")) == 8
    said = []
    resumable(Replay(moving()), settings, tmp_path / "out", notify=said.append)
    kept = [line for line in said if "goes on after its first" in line]
    assert len(kept) == 1
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_sink_of_one_s_own_sees_every_scan_once(tmp_path, settings):
    whole, resumed = Seeing(), Seeing()
    out = tmp_path / "out"
    resumable(Replay(moving()), settings, out, [Copying(out, tmp_path, (6,)), whole])
    resumable(Replay(moving()), settings, tmp_path / "6", [resumed])
    assert resumed.indices == list(range(COUNT))
    assert resumed.kept == whole.kept


def test_what_a_killed_run_leaves_can_be_read(tmp_path, settings):
    [folder], _ = killed_at(Replay(moving()), settings, tmp_path, (8,))
    mark = json.loads((folder / MARK).read_text())
    assert mark["scans"] > 1
    assert "--resume" in mark["resume"]
    poses = read_tum(folder / "trajectory.tum")
    assert len(poses) >= 8
    whole = read_tum(tmp_path / "whole" / "trajectory.tum")
    np.testing.assert_array_equal(poses.poses, whole.poses[: len(poses)])
    assert {entry.name for entry in (tmp_path / "whole").iterdir()}.isdisjoint({MARK, JOURNAL})


def test_a_journal_that_is_cut_anywhere_in_its_last_record(tmp_path, settings):
    """Behind the checkpoint the rest is dropped; before it, the run starts anew."""
    [folder], _ = killed_at(Replay(moving()[:4]), settings, tmp_path, (3,))
    path = folder / JOURNAL / "results"
    data, ends = path.read_bytes(), []
    with path.open("rb") as file:
        while file.tell() < len(data):
            read_record(file)
            ends.append(file.tell())
    assert len(ends) >= 3
    with (folder / JOURNAL / "checkpoint").open("rb") as file:
        values = read_record(file).values
    assert values["bytes"] == ends[values["scans"] - 1]
    sequence = Replay(moving()[:4])
    # a checkpoint of the scan before the last record; without arrays it is read faster
    before = {"scans": len(ends) - 1, "bytes": ends[-2]}
    (folder / JOURNAL / "checkpoint").write_bytes(Record(before, []).as_bytes())
    for size in (*range(ends[-2], ends[-2] + 30), *range(ends[-2] + 30, ends[-1], 2999), ends[-1] - 1):
        path.write_bytes(data[:size])
        with opened_journal(folder, sequence, settings) as journal:
            assert (journal.scans, journal.problem) == (len(ends) - 1, "")
            # what lies behind the checkpoint is gone
            assert path.read_bytes() == data[: ends[-2]]
    path.write_bytes(data[: ends[-2] - 1])
    said = []
    result = resumable(sequence, settings, folder, notify=said.append)
    [note] = said
    assert note.endswith("kept (its journal is shorter than its checkpoint says); it starts anew.")
    assert "resumed_at_scan" not in result.metrics
    assert contents(folder) == contents(tmp_path / "whole")


def test_a_record_that_is_cut_or_changed_is_refused(tmp_path):
    record = Record({"a": 1.5}, [np.arange(5, dtype=np.int16), np.array(True), np.zeros((0, 3))])
    data = record.as_bytes()
    path = tmp_path / "record"
    path.write_bytes(data)
    with path.open("rb") as file:
        values, arrays = read_record(file)
    assert values == record.values
    assert [(one.dtype, one.shape, one.tobytes()) for one in arrays] == [
        (one.dtype, one.shape, one.tobytes()) for one in record.arrays
    ]
    for size in range(len(data)):
        path.write_bytes(data[:size])
        with path.open("rb") as file, pytest.raises(ValueError, match="record"):
            read_record(file)
    for at in range(len(data)):
        path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
        with path.open("rb") as file, pytest.raises(ValueError, match="record is damaged"):
            read_record(file)


@pytest.mark.parametrize("damage", ["step", "checkpoint"])
def test_a_damaged_journal(tmp_path, settings, damage):
    [folder], whole = killed_at(Replay(moving()), settings, tmp_path, (8,))
    path = folder / JOURNAL / {"step": "results", "checkpoint": "checkpoint"}[damage]
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    path.write_bytes(data)
    if damage == "checkpoint":
        resumable(Replay(moving()), settings, folder)
        assert contents(folder) == whole
        return
    with pytest.raises(LioJaxError, match=r"results: cannot be used .*; add --overwrite to start anew"):
        resumable(Replay(moving()), settings, folder)


def test_another_recording_or_another_state(tmp_path, settings):
    [folder], _ = killed_at(Replay(moving()), settings, tmp_path, (8,))
    later = [replace(scan, stamp_ns=scan.stamp_ns + 1) for scan in moving()]
    with pytest.raises(LioJaxError, match=r"memory: scan 0 is not the one that the unfinished run in"):
        resumable(Replay(later), settings, folder)
    path = folder / JOURNAL / "checkpoint"
    with path.open("rb") as file:
        found = read_record(file)
    path.write_bytes(Record(found.values, found.arrays[:-1]).as_bytes())
    result = resumable(Replay(moving()), settings, folder)
    assert "left by another version of the program or of the recipe" in str(result.interruption)
    assert (folder / MARK).exists()


def test_other_settings_are_named(tmp_path, settings):
    [folder], _ = killed_at(Replay(moving()), settings, tmp_path, (8,))
    changed = with_overrides(settings, ["params.map.point_spacing=0.3"])
    with pytest.raises(UsageError, match=r"params\.map\.point_spacing was .* and is now 0\.3; give the same"):
        resumable(Replay(moving()), changed, folder)
    with pytest.raises(UsageError, match=r"--scans was None and is now 5"):
        resumable(Replay(moving()), settings, folder, count=5)
    moved = Replay(moving())
    moved.info = replace(moved.info, path="elsewhere")
    with pytest.raises(UsageError, match=r"DATA was .*memory and is now .*elsewhere"):
        resumable(moved, settings, folder)
    assert read_unfinished(folder).scans > 1


def test_a_full_disk_ends_the_journal_and_not_the_run(tmp_path, settings, monkeypatch):
    def full(file, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(journal_module, "_written", full)
    result = resumable(Replay(moving()), settings, tmp_path / "out")
    assert len(result.trajectory) == COUNT
    assert any("the journal ended early (OSError: [Errno 28]" in line for line in result.metrics["warnings"])
    assert not (tmp_path / "out" / JOURNAL).exists()


IN_A_PROCESS = """
import sys
from lio_jax.run import journal
journal.CHECKPOINT_EVERY_S = 0.05
from lio_jax.commands import run
scan, take = int(sys.argv[1]), run._ProgressBar.take

def killed(self, result):
    take(self, result)
    if result.index == scan:
        import os, signal, time
        time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGKILL)

run._ProgressBar.take = killed
from lio_jax.cli import main
sys.exit(main(sys.argv[2:]))
"""


def in_a_process(scan, *words):
    words = [str(word) for word in words]
    return subprocess.run(
        [sys.executable, "-c", IN_A_PROCESS, str(scan), *words],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )


@pytest.mark.long
def test_processes_that_are_killed_one_after_the_other(tmp_path):
    data, part = tmp_path / "data", inertial_drive.scans()
    T_imu_lidar = inertial_drive.drive().info.T_imu_lidar
    write_native(
        data,
        part,
        imu=inertial_drive.imu(),
        T_imu_lidar=T_imu_lidar,
        truth=inertial_drive.truth(),
        sensor="s",
    )
    given = ("--set", "config.lidar.buckets=[4096]", "config.imu.buckets=[512]", *PLAIN[1:])
    done = in_a_process(-1, "run", data, "--out", tmp_path / "whole", *given)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "out"
    words = ("run", data, "--out", out, *given)
    for scan in np.sort(np.random.default_rng(5).choice(len(part), 3, replace=False)):
        done = in_a_process(scan, *words, "--resume")
        assert done.returncode == -signal.SIGKILL, done.stderr
        assert len(read_tum(out / "trajectory.tum")) > 0
    done = in_a_process(-1, *words)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == (
        f"lio-jax: {out}: holds an unfinished run of {read_unfinished(out).scans} scans; add --resume to go "
        "on or --overwrite to start anew."
    )
    # without settings, those of the killed run hold
    done = in_a_process(-1, "run", data, "--out", out, "--resume")
    assert done.returncode == 0, done.stderr
    assert "note: the unfinished run goes on after its first" in done.stderr
    one, other = contents(out), contents(tmp_path / "whole")
    for found in (one, other):
        # whether the calibration was given or found in the recording
        found.pop("metrics notes")
    assert one == other
    assert {entry.name for entry in out.iterdir()} == {entry.name for entry in (tmp_path / "whole").iterdir()}


def test_no_module_stores_python_objects():
    """A pickle runs code when it is read: nobody may send one as a run folder."""
    import lio_jax

    for path in Path(lio_jax.__file__).parent.glob("run/*.py"):
        assert "pickle" not in path.read_text().replace("allow_pickle=False", ""), path
