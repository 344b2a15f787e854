"""imu_rate.tum: every inertial sample has its pose, those between scans too."""

from pathlib import Path

import numpy as np
import pytest

from lio_jax.data.trajectory import Trajectory, read_tum
from lio_jax.run import state_files as imu_rate
from lio_jax.run.logs import TrajectoryLog
from lio_jax.run.run import run_sequence
from lio_jax.run.state_files import write_imu_rate
from lio_jax.settings.settings import Settings
from tests.run.inertial_drive import InertialReplay, drive, errors, imu, scans


@pytest.fixture(scope="module")
def run(inertial_settings: Settings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    result = run_sequence(InertialReplay(scans(), imu()), inertial_settings, out)
    assert result.interruption is None
    return out


@pytest.fixture(scope="module")
def at_samples(run: Path) -> Trajectory:
    return read_tum(run / "imu_rate.tum")


def test_every_sample_after_the_first_scan_has_its_pose(run: Path, at_samples: Trajectory) -> None:
    ends = read_tum(run / "trajectory.tum").stamp_ns
    stamps = imu().stamp_ns
    expected = stamps[(stamps > ends[0]) & (stamps <= ends[-1])]
    np.testing.assert_array_equal(at_samples.stamp_ns, expected)


def test_poses_at_scan_ends_are_those_of_the_trajectory(run: Path) -> None:
    _, *at_ends = (run / "trajectory.tum").read_text().splitlines()
    assert set(at_ends) <= set((run / "imu_rate.tum").read_text().splitlines())


def test_poses_between_scans_agree_with_the_truth(run: Path, at_samples: Trajectory) -> None:
    at_ends = read_tum(run / "trajectory.tum")
    between = ~np.isin(at_samples.stamp_ns, at_ends.stamp_ns)
    between = Trajectory(at_samples.stamp_ns[between], at_samples.poses[between])
    assert len(between) > 250
    # measured: 0.009 m
    assert errors(between, at_ends).max() < 0.02
    # from sample to sample the largest step is a scan's correction: 0.002 m measured, 0.006 m in the first
    # scans, whose mean poses alone tell the velocity that leads to their ends
    known = at_samples.stamp_ns > at_ends.stamp_ns[3]
    truth = drive().truth().at(at_samples.stamp_ns).poses
    steps = [np.linalg.inv(poses[known][:-1]) @ poses[known][1:] for poses in (truth, at_samples.poses)]
    assert np.linalg.norm((steps[0] - steps[1])[:, :3, 3], axis=1).max() < 0.005


def test_in_pieces_it_is_the_same(run: Path, tmp_path: Path, monkeypatch) -> None:
    states = np.load(run / "states.npz")
    log = TrajectoryLog()
    for number in range(len(states["stamps_ns"])):
        log._rows.append({name: states[name][number] for name in states.files})
    monkeypatch.setattr(imu_rate, "_SCANS_AT_ONCE", 7)
    write_imu_rate(tmp_path / "imu_rate.tum", log, imu())
    assert (tmp_path / "imu_rate.tum").read_text() == (run / "imu_rate.tum").read_text()


def test_scans_whose_time_steps_back_are_passed_over(run: Path, tmp_path: Path) -> None:
    states = np.load(run / "states.npz")
    log = TrajectoryLog()
    for number in (0, 1, 5, 3, 4, 6, 7):
        log._rows.append({name: states[name][number] for name in states.files})
    write_imu_rate(tmp_path / "imu_rate.tum", log, imu())
    found = read_tum(tmp_path / "imu_rate.tum").stamp_ns
    assert np.all(np.diff(found) > 0)
    assert found[-1] == states["stamps_ns"][7]


def test_one_scan_leaves_an_empty_file(run: Path, tmp_path: Path) -> None:
    states = np.load(run / "states.npz")
    log = TrajectoryLog()
    log._rows.append({name: states[name][0] for name in states.files})
    write_imu_rate(tmp_path / "imu_rate.tum", log, imu())
    assert (tmp_path / "imu_rate.tum").read_text() == ""
    assert [entry.name for entry in tmp_path.iterdir()] == ["imu_rate.tum"]
