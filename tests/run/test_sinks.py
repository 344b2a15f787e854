"""A user's own sinks beside a run's: what they see, and what their errors cost."""

import json

import numpy as np
import pytest

from lio_jax.data.trajectory import read_tum
from lio_jax.run.keyframes import KeyframeWriter
from lio_jax.run.run import run_sequence
from lio_jax.run.sinks import RunResult, Sink, finish_all
from lio_jax.run.state_files import StateFiles
from lio_jax.settings.settings import with_overrides
from tests.run.small_drive import COUNT, Replay, moving


class Speeds(Sink):
    """Adds the highest speed to the metrics."""

    def __init__(self, out):
        self.out, self.speeds, self.calls = out, [], []

    def take(self, result):
        assert "finish" not in self.calls
        self.speeds.append(float(np.linalg.norm(result.nav.velocity)))

    def finish(self, run):
        self.calls.append("finish")
        self.poses_written = len(read_tum(self.out / "trajectory.tum"))
        self.poses_known = len(run.trajectory)
        run.metrics["highest_speed"] = max(self.speeds)
        run.metrics["warnings"].append("fast.")

    def close(self):
        self.calls.append("close")


class Failing(Sink):
    def __init__(self, error, at="finish"):
        self.error, self.at = error, at

    def take(self, result):
        if self.at == "take" and result.index == 3:
            raise self.error

    def finish(self, run):
        if self.at == "finish":
            raise self.error


def metrics_in(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_a_sink_sees_every_scan_and_adds_to_the_metrics(tmp_path, settings):
    own = Speeds(tmp_path)
    result = run_sequence(Replay(moving()), settings, tmp_path, sinks=[own])
    assert len(own.speeds) == own.poses_written == own.poses_known == COUNT
    assert own.calls == ["finish", "close"]
    assert metrics_in(tmp_path)["highest_speed"] == result.metrics["highest_speed"] == max(own.speeds) > 1
    assert metrics_in(tmp_path)["warnings"] == ["fast."]
    assert result.interruption is None


def test_a_sink_that_only_takes_needs_nothing_else(tmp_path, settings):
    class Counting(Sink):
        count = 0

        def take(self, result):
            self.count += 1

    own = Counting()
    run_sequence(Replay(moving()), settings, tmp_path, count=4, sinks=[own])
    assert own.count == 4


def test_an_error_in_take_ends_the_run_and_all_finish(tmp_path, settings):
    error, own = ValueError("enough"), Speeds(tmp_path)
    result = run_sequence(Replay(moving()), settings, tmp_path, sinks=[Failing(error, "take"), own])
    assert result.interruption is error
    assert result.unfinished == []
    assert metrics_in(tmp_path)["scans"] == own.poses_written == 4
    # those after the one that failed did not get the last scan
    assert len(own.speeds) == 3
    assert own.calls == ["finish", "close"]


def test_an_error_in_finish_costs_that_sink_alone(tmp_path, settings):
    error, own = OSError("the printer is on fire"), Speeds(tmp_path)
    result = run_sequence(Replay(moving()), settings, tmp_path, sinks=[Failing(error), own])
    assert result.interruption is error
    assert result.unfinished == [error]
    assert metrics_in(tmp_path)["scans"] == COUNT
    first, second = metrics_in(tmp_path)["warnings"]
    assert first.startswith("Failing could not finish (OSError: the printer is on fire)")
    assert second == "fast."
    assert own.poses_written == COUNT


def test_one_of_the_run_s_own_that_cannot_finish_costs_its_files_alone(tmp_path, settings, monkeypatch):
    def broken(self, path):
        raise OSError("the disk is gone")

    monkeypatch.setattr("lio_jax.run.logs.TrajectoryLog.write_npz", broken)
    result = run_sequence(Replay(moving()), settings, tmp_path)
    assert str(result.interruption) == "the disk is gone"
    written = {entry.name for entry in tmp_path.iterdir()}
    assert written == {"map.pcd", "metrics.json", "scans.npz", "trajectory.tum", "trajectory_kitti.txt"}
    assert result.map_points is not None


@pytest.mark.parametrize("broken", [(KeyframeWriter, "finish"), (StateFiles, "write_trajectory")])
def test_a_correction_that_cannot_be_written_leaves_the_odometry(tmp_path, settings, monkeypatch, broken):
    where, method = broken
    original, calls = getattr(where, method), []

    def failing(self, *given):
        calls.append(given)
        # the trajectory is written by the odometry first
        if where is KeyframeWriter or len(calls) > 1:
            raise OSError("the disk is gone")
        return original(self, *given)

    monkeypatch.setattr(where, method, failing)
    with_loops = with_overrides(settings, ["config.backend.loops=true"])
    result = run_sequence(Replay(moving()), with_loops, tmp_path)
    assert str(result.interruption) == "the disk is gone"
    assert (tmp_path / "scans.npz").exists()
    assert result.metrics["backend"]["keyframes"] > 1
    assert result.trajectory is result.odometry
    np.testing.assert_allclose(read_tum(tmp_path / "trajectory.tum").poses, result.odometry.poses, atol=1e-8)


def test_sinks_are_closed_where_nothing_could_be_read(tmp_path, settings):
    class Broken(Replay):
        def scans(self, start=0, count=None):
            raise ZeroDivisionError
            yield

    own = Speeds(tmp_path)
    with pytest.raises(ZeroDivisionError):
        run_sequence(Broken(moving()), settings, tmp_path, sinks=[own])
    assert own.calls == ["close"]


def test_an_interruption_is_not_hidden_by_a_sink_that_cannot_finish():
    stopped, error = KeyboardInterrupt(), ValueError("no")
    run = RunResult(interruption=stopped)
    finish_all([Failing(error)], run)
    assert run.interruption is stopped
    assert run.unfinished == [error]
