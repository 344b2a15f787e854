"""states.npz holds every part of the navigation state under its name, in its order."""

from pathlib import Path
from types import SimpleNamespace

import jaxlie
import numpy as np
import pytest

from lio_jax.core.types import NavState
from lio_jax.run.logs import TrajectoryLog
from lio_jax.run.track import ScanResult, pose_matrix

EXTRINSIC = np.array([0.5, 0.5, 0.5, 0.5, 0.1, 0.2, 0.3])


def result(index: int) -> ScanResult:
    """Return a scan's result in which no two numbers of the state agree."""
    pose = np.array([1.0, 0.0, 0.0, 0.0, float(index), 0.0, 0.0])
    nav = NavState(
        T_world_imu=jaxlie.SE3(pose),
        velocity=np.array([1.0, 2.0, 3.0]) + index,
        gyro_bias=np.array([0.01, 0.02, 0.03]) + index,
        accel_bias=np.array([0.4, 0.5, 0.6]) + index,
        gravity=np.array([0.7, 0.8, -9.7]),
        T_imu_lidar=jaxlie.SE3(EXTRINSIC),
        time_offset=np.array(0.004 + index),
    )
    registration = SimpleNamespace(T_world_lidar=jaxlie.SE3(EXTRINSIC), information=np.eye(6))
    output = SimpleNamespace(
        registration=registration, covariance=None, nis=np.array(5.0), nis_dof=np.array(6)
    )
    return ScanResult(index, 100 + index, pose_matrix(pose), nav, output, 1, {}, "")


@pytest.fixture
def states(tmp_path: Path) -> dict[str, np.ndarray]:
    log = TrajectoryLog()
    for index in range(2):
        log.take(result(index))
    log.write_npz(tmp_path / "states.npz")
    with np.load(tmp_path / "states.npz") as file:
        return dict(file)


def test_the_file_holds_the_promised_names(states: dict[str, np.ndarray]) -> None:
    contract = {"stamps_ns", "poses", "velocity", "biases", "gravity", "extrinsic", "covariance"}
    assert set(states) == contract | {"time_offset", "nis", "nis_dof"}


def test_biases_are_the_gyroscope_s_then_the_accelerometer_s(states: dict[str, np.ndarray]) -> None:
    np.testing.assert_allclose(
        states["biases"], [[0.01, 0.02, 0.03, 0.4, 0.5, 0.6], [1.01, 1.02, 1.03, 1.4, 1.5, 1.6]]
    )


def test_each_column_is_what_its_name_says(states: dict[str, np.ndarray]) -> None:
    assert states["stamps_ns"].tolist() == [100, 101]
    assert states["stamps_ns"].dtype == np.int64
    np.testing.assert_array_equal(states["poses"][:, :3, 3], [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(states["velocity"], [[1, 2, 3], [2, 3, 4]])
    np.testing.assert_array_equal(states["gravity"], [[0.7, 0.8, -9.7]] * 2)
    np.testing.assert_array_equal(states["time_offset"], [0.004, 1.004])
    # a third of a turn about (1, 1, 1): x to y, y to z, z to x
    np.testing.assert_allclose(
        states["extrinsic"][0], [[0, 0, 1, 0.1], [1, 0, 0, 0.2], [0, 1, 0, 0.3], [0, 0, 0, 1]], atol=1e-12
    )
    assert states["covariance"].shape == (2, 6, 6)
    assert not states["covariance"][0].any()
