"""One compiled step and one tracked drive for all tests of the runner."""

import pytest

from lio_jax.run.compiled import CompiledStep
from lio_jax.run.track import ScanResult, track
from lio_jax.settings.settings import Settings, with_extrinsics, with_overrides
from tests.run import inertial_drive, small_drive


@pytest.fixture(scope="session")
def settings() -> Settings:
    T_imu_lidar = small_drive.drive().info.T_imu_lidar
    assert T_imu_lidar is not None
    one_size = with_overrides(Settings(), ["config.lidar.buckets=[8192]"])
    return with_extrinsics(one_size, T_imu_lidar, "the drive")


@pytest.fixture(scope="session")
def inertial_settings() -> Settings:
    """Samples of a 5 s outage fit into the one padded size."""
    T_imu_lidar = inertial_drive.drive().info.T_imu_lidar
    assert T_imu_lidar is not None
    one_size = with_overrides(Settings(), ["config.lidar.buckets=[4096]", "config.imu.buckets=[512]"])
    return with_extrinsics(one_size, T_imu_lidar, "the drive")


@pytest.fixture(scope="session")
def step(settings: Settings) -> CompiledStep:
    return CompiledStep(settings)


@pytest.fixture(scope="session")
def tracked(settings: Settings, step: CompiledStep) -> list[ScanResult]:
    return list(track(settings, small_drive.moving(), step=step))
