"""``lio-jax eval RUN --gps RECORDING`` with a simulated receiver."""

import json

import numpy as np
import pytest

from lio_jax.data import write_native
from lio_jax.data.trajectory import Trajectory, write_tum
from lio_jax.settings.settings import Settings, with_overrides
from lio_jax.sim.gps import GpsModel
from lio_jax.sim.sequence import SimulatedSequence
from tests.data.test_native import scans

RECEIVER = GpsModel(rate=5.0, noise=(0.3, 0.3, 0.6), multipath=0.0)
ADDED = np.array([0.6, 0.8, 0.0])


@pytest.fixture(scope="module")
def drive():
    return SimulatedSequence("street", "vlp16", 40.0, seed=2, standstill_s=0.0, gps=RECEIVER)


@pytest.fixture(scope="module")
def recording(drive, tmp_path_factory):
    path = tmp_path_factory.mktemp("gps") / "recording"
    write_native(path, scans(1), gps=drive.gps())
    return path


def run_folder(path, drive, *settings):
    """Return a run folder whose trajectory is the truth with an error of 1 m in every second pose."""
    path.mkdir()
    seconds = np.arange(0.0, 40.0, 0.2)
    poses = drive.poses(seconds)
    poses[::2, :3, 3] += ADDED
    first = drive.gps().stamp_ns[0]
    write_tum(path / "trajectory.tum", Trajectory(first + np.round(seconds * 1e9).astype(np.int64), poses))
    (path / "config.yaml").write_text(with_overrides(Settings(), settings).to_yaml())
    return path


def test_a_known_error_comes_back(cli, drive, recording, tmp_path):
    done = cli("eval", run_folder(tmp_path / "run", drive), "--gps", recording, "--json")
    assert (done.status, done.err) == (0, "")
    found = json.loads(done.out)
    assert found["compared"] == found["fixes"] - 1
    assert found["left_out"] == {"outside the trajectory's time span": 1}
    # half a metre each about the mean, and the noise of two axes
    assert found["horizontal"]["rmse"] == pytest.approx(np.hypot(0.5, 0.3 * np.sqrt(2)), rel=0.08)
    assert found["vertical"]["rmse"] == pytest.approx(0.6, rel=0.12)
    assert found["vertical"]["inside_3_sigma"] == pytest.approx(0.9973, abs=0.011)
    assert found["horizontal"]["fix_sigma"] == pytest.approx(0.3)
    assert found["drift_m_per_100_m"] < 1.5
    assert found["notes"] == []


def test_the_table_and_the_lever_arm(cli, drive, recording, tmp_path):
    run = run_folder(tmp_path / "run", drive, "params.gps.lever_arm=[0,0,2]", "config.backend.gps=true")
    done = cli("eval", run, "--gps", recording)
    assert done.status == 0, done.err
    assert "200 of 201 GPS fixes compared" in done.out
    assert "antenna at (0, 0, 2) m in the IMU frame (params.gps.lever_arm)" in done.out
    assert "left out: 1 outside the trajectory's time span" in done.out
    assert "these are no independent truth" in done.out
    (run / "odometry.tum").write_bytes((run / "trajectory.tum").read_bytes())
    done = cli("eval", run / "odometry.tum", "--gps", recording)
    assert "antenna at (0, 0, 2) m" in done.out
    assert "independent" not in done.out
    done = cli("eval", run, "--gps", recording, "--set", "params.gps.lever_arm=[1,0,0]")
    assert "antenna at (1, 0, 0) m" in done.out


def test_what_cannot_be_compared_with_fixes(cli, drive, recording, tmp_path):
    run = run_folder(tmp_path / "run", drive)
    blind = tmp_path / "blind"
    write_native(blind, scans(1))
    later = tmp_path / "later.tum"
    later.write_text("1000.0 0 0 0 0 0 0 1\n1001.0 0 0 0 0 0 0 1\n")
    for words, status, message in (
        ((run, "--gps", blind), 1, "blind: holds no GPS fixes; give the recording that holds them"),
        ((later, "--gps", recording), 1, "No GPS fix of"),
        ((run, "--gps", tmp_path / "nothing"), 1, "nothing: no such file or folder"),
        ((run,), 2, "eval: needs either REFERENCE or --gps DATA"),
        ((run, run, "--gps", recording), 2, "eval: needs either REFERENCE or --gps DATA"),
        ((run, run, "--set", "params.gps.spacing=1"), 2, "--set has an effect with --gps only"),
    ):
        done = cli("eval", *words)
        assert (done.status, done.out) == (status, "")
        assert message in done.err
        assert done.err.count("\n") == 1
