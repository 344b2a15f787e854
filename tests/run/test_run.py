"""The results of a run that meets errors on the way."""

import json
import threading
from dataclasses import replace

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.trajectory import read_tum
from lio_jax.run.run import run_sequence, settings_for
from lio_jax.run.sinks import Sink
from lio_jax.settings.settings import with_overrides
from tests.run.small_drive import COUNT, Replay, moving, without_points

FILES = [
    "config.yaml",
    "keyframes.g2o",
    "map.pcd",
    "metrics.json",
    "scans.npz",
    "states.npz",
    "trajectory.tum",
]


class _StopAfter(Sink):
    def __init__(self, scans, error):
        self._last, self._error = scans - 1, error

    def take(self, result):
        if result.index == self._last:
            raise self._error


def _names(path):
    return sorted(entry.name for entry in path.iterdir() if entry.name != "trajectory_kitti.txt")


@pytest.mark.parametrize("scans", [1, 5])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError("the disk is gone"), ValueError("a bug")])
def test_what_was_computed_is_written(tmp_path, settings, scans, error):
    result = run_sequence(Replay(moving()), settings, tmp_path, sinks=[_StopAfter(scans, error)])
    assert result.interruption is error
    assert len(result.trajectory) == scans
    assert len(read_tum(tmp_path / "trajectory.tum")) == scans
    assert json.loads((tmp_path / "metrics.json").read_text())["scans"] == scans
    assert np.load(tmp_path / "states.npz")["poses"].shape == (scans, 4, 4)
    assert _names(tmp_path) == FILES
    assert all(len(values) >= scans for stage, values in result.stage_ms.items() if stage != "record")


def test_an_interrupted_run_leaves_no_thread(tmp_path, settings):
    closed = []

    class Watched(Replay):
        def scans(self, start=0, count=None):
            try:
                yield from super().scans(start, count)
            finally:
                closed.append(True)

    result = run_sequence(
        Watched(moving() * 3), settings, tmp_path, sinks=[_StopAfter(2, KeyboardInterrupt())]
    )
    assert isinstance(result.interruption, KeyboardInterrupt)
    assert closed == [True]
    assert not [thread for thread in threading.enumerate() if thread.name == "prefetch"]


def test_an_error_of_the_reader_ends_the_run_with_what_there_is(tmp_path, settings):
    class Breaking(Replay):
        def scans(self, start=0, count=None):
            yield from super().scans(0, 4)
            raise LioJaxError("the disk was pulled out.")

    result = run_sequence(Breaking(moving()), settings, tmp_path)
    assert str(result.interruption) == "the disk was pulled out."
    assert len(result.trajectory) == 4


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_nothing_is_written_before_the_first_scan(tmp_path, settings, error):
    class Broken(Replay):
        def scans(self, start=0, count=None):
            raise error
            yield

    with pytest.raises(error):
        run_sequence(Broken(moving()), settings, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_recording_without_a_readable_scan_says_why(tmp_path, settings):
    silent = Replay([])
    silent.warnings_so_far = ("a.npz: cannot be read.",)
    with pytest.raises(LioJaxError, match=r"memory: no scan could be read. a.npz: cannot be read."):
        run_sequence(silent, settings, tmp_path)


def test_start_behind_the_end_says_how_many_scans_there_are(tmp_path, settings):
    with pytest.raises(
        UsageError, match=rf"memory: holds {COUNT} scans, numbered from 0, so none from 99 on"
    ):
        run_sequence(Replay(moving()), settings, tmp_path, start=99)


def test_failures_name_the_scan_by_its_place_in_the_recording(tmp_path, settings):
    scans = list(moving())
    scans[6] = without_points(scans[6])
    result = run_sequence(Replay(scans), settings, tmp_path, start=4, count=5)
    [failure] = result.metrics["failures"]
    assert failure["scan"] == 6
    assert failure["stamp_ns"] == scans[6].end_ns
    assert failure["message"].startswith("scan 6: it holds no points")
    assert result.metrics["scans"] == 5


def test_first_pose_is_certain_and_the_others_are_known(tmp_path, settings):
    run_sequence(Replay(moving()), settings, tmp_path)
    covariance = np.load(tmp_path / "states.npz")["covariance"]
    assert not covariance[0].any()
    assert np.linalg.eigvalsh(covariance[1:]).min() > 0
    sigma = np.sqrt(np.diagonal(covariance[1:], axis1=1, axis2=2))
    assert sigma.max() < 0.1


def test_without_a_map_there_is_no_map(tmp_path, settings):
    result = run_sequence(Replay(moving()), with_overrides(settings, ["config.output.map=false"]), tmp_path)
    assert result.map_points is None
    assert not (tmp_path / "map.pcd").exists()


def test_map_points_lie_on_the_world(tmp_path, settings):
    points = run_sequence(Replay(moving()), settings, tmp_path).map_points
    assert points is not None
    assert len(points) > 5000
    # the street is flat and the body frame starts 1.5 m above it
    ground = points[np.abs(points[:, 2] + 1.5) < 0.3]
    near = ground[np.linalg.norm(ground[:, :2], axis=1) < 10]
    assert abs(np.median(near[:, 2]) + 1.5) < 0.03


def test_capacities_that_overflow_are_reported(tmp_path, settings):
    small = with_overrides(
        settings,
        ["config.lidar.buckets=[4096]", "config.map.capacity=1024", "config.lidar.insertion_points=2048"],
    )
    result = run_sequence(Replay(moving()[:4]), small, tmp_path)
    overflow = result.metrics["overflow"]
    assert overflow["scans_over_largest_bucket"] == 4
    assert overflow["cells_thinned_away_per_scan"] > 0
    assert overflow["map_points_dropped"] > 0.05 * overflow["map_points_offered"]
    first, second = result.metrics["warnings"]
    assert first.startswith("4 scans hold more than 4096 points")
    assert "found no room in the map of 1024 voxels" in second


def test_capacities_that_suffice_are_not_mentioned(tmp_path, settings):
    result = run_sequence(Replay(moving()), settings, tmp_path)
    assert result.metrics["warnings"] == []
    assert result.metrics["overflow"]["scans_over_largest_bucket"] == 0


def test_extrinsics_come_from_the_recording_unless_given(settings):
    recording = Replay(moving())
    taken, notes = settings_for(recording, with_overrides(type(settings)(), []))
    assert taken.values["extrinsics"] == settings.values["extrinsics"]
    assert notes[0] == "T_imu_lidar: from the recording's calibration."
    given = with_overrides(type(settings)(), ["params.extrinsics.translation=[0,0,0.28]"])
    kept, notes = settings_for(recording, given)
    assert kept.values["extrinsics"] == given.values["extrinsics"]
    assert notes[0] == "T_imu_lidar: as given in the settings; the recording's calibration is not used."
    recording.info = replace(recording.info, T_imu_lidar=None)
    assert settings_for(recording, type(settings)())[1][0].startswith("T_imu_lidar: not in the recording")
