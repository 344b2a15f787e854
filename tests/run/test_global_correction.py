"""The back end during a run: its files, its frame on the earth, and its failures."""

import json

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.trajectory import read_tum
from lio_jax.loops.back_end import BackEnd
from lio_jax.run.keyframes import read_keyframes
from lio_jax.run.map_file import read_cloud
from lio_jax.run.run import run_sequence, settings_for
from lio_jax.run.sinks import Sink
from lio_jax.settings.settings import Settings, with_overrides
from lio_jax.sim.gps import GpsModel
from lio_jax.sim.sequence import SimulatedSequence
from tests.run.small_drive import Replay, moving

BOTH = ["config.backend.loops=true", "config.backend.gps=true"]
GPS_TIES_AT = ["params.gps.min_travel=2.0", "params.gps.spacing=1.0", "params.gps.yaw_sigma=0.3"]


@pytest.fixture(scope="module")
def recording():
    """Return a drive with an almost exact receiver, so that a few metres show the heading."""
    gps = GpsModel(noise=(0.02, 0.02, 0.02), multipath=0.0)
    return SimulatedSequence("street", duration_s=6.0, beams=16, columns=256, gps=gps, moving_start=True)


@pytest.fixture(scope="module")
def finished(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    settings, _ = settings_for(recording, with_overrides(Settings(), [*BOTH, *GPS_TIES_AT]))
    return run_sequence(recording, settings, out), out


def test_both_trajectories_are_kept(finished, recording):
    result, out = finished
    smooth, corrected = read_tum(out / "odometry.tum"), read_tum(out / "trajectory.tum")
    np.testing.assert_allclose(smooth.poses, np.load(out / "states.npz")["poses"], atol=1e-8)
    np.testing.assert_allclose(result.trajectory.poses, corrected.poses, atol=1e-8)
    np.testing.assert_allclose(result.odometry.poses, smooth.poses, atol=1e-8)
    truth = recording.truth().at(corrected.stamp_ns)
    way = np.linalg.norm(truth.positions[-1] - truth.positions[0])
    assert abs(np.linalg.norm(corrected.positions[-1] - corrected.positions[0]) - way) < 0.2
    assert not np.array_equal(smooth.poses, corrected.poses)


def test_the_world_lies_on_the_earth(finished, recording):
    _, out = finished
    reference = json.loads((out / "georeference.json").read_text())
    assert reference["origin"] == {"latitude_deg": 48.1, "longitude_deg": 11.6, "altitude_m": 520.0}
    corrected = read_tum(out / "trajectory.tum")
    on_earth = np.array(reference["T_enu_world"]) @ corrected.poses
    truth = recording.truth().at(corrected.stamp_ns)
    np.testing.assert_allclose(on_earth[: len(truth), :3, 3], truth.positions, atol=0.3)
    counts = json.loads((out / "metrics.json").read_text())["backend"]["gps"]
    assert counts["used"] > 5


def test_keyframes_and_map_are_those_of_the_corrected_trajectory(finished):
    _, out = finished
    kept = read_keyframes(out)
    corrected = read_tum(out / "trajectory.tum")
    rows = np.searchsorted(corrected.stamp_ns, kept.stamps_ns)
    np.testing.assert_allclose(kept.T_world_imu, corrected.poses[rows], atol=1e-6)
    assert len(read_cloud(out / "map.pcd")) > 5000
    vertices = [line for line in (out / "keyframes.g2o").read_text().splitlines() if "VERTEX" in line]
    assert len(vertices) == len(kept.stamps_ns)
    assert json.loads((out / "loops.json").read_text()) == {"loops": []}


def test_gps_of_a_recording_without_any_is_refused_before_the_run(tmp_path, settings):
    with pytest.raises(LioJaxError, match="holds no GPS fixes"):
        run_sequence(Replay(moving()), with_overrides(settings, BOTH), tmp_path)


def test_a_back_end_that_fails_costs_the_correction_alone(tmp_path, settings, monkeypatch):
    take = BackEnd.add

    def failing(self, keyframe):
        if keyframe.index == 1:
            raise RuntimeError("out of luck")
        take(self, keyframe)

    monkeypatch.setattr(BackEnd, "add", failing)
    result = run_sequence(Replay(moving()), with_overrides(settings, BOTH[:1]), tmp_path)
    assert any(
        "the back end ended early (RuntimeError: out of luck)" in w for w in result.metrics["warnings"]
    )
    smooth, corrected = read_tum(tmp_path / "odometry.tum"), read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(corrected.poses, smooth.poses, atol=1e-6)
    assert len(read_keyframes(tmp_path).stamps_ns) > 1


def test_pairs_of_times_without_keyframes_are_named(tmp_path, settings):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("1 42\n33 38\n")
    named = with_overrides(settings, [*BOTH[:1], f"config.loops.pairs={pairs}"])
    result = run_sequence(Replay(moving()[:4]), named, tmp_path / "run")
    (warning,) = [warning for warning in result.metrics["warnings"] if str(pairs) in warning]
    assert "2 pairs closed no loop" in warning
    assert "(lines 1, 2)" in warning


def test_ctrl_c_keeps_what_is_corrected(tmp_path, settings):
    class Interrupt(Sink):
        def take(self, result):
            if result.index == 5:
                raise KeyboardInterrupt

    result = run_sequence(Replay(moving()), with_overrides(settings, BOTH[:1]), tmp_path, sinks=[Interrupt()])
    assert isinstance(result.interruption, KeyboardInterrupt)
    assert len(read_tum(tmp_path / "trajectory.tum")) == 6
    assert (tmp_path / "map.pcd").exists()
