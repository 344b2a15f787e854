"""One compiled step and one tracked drive for all tests of the runner."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from lio_jax.commands.runtime import prepare_jax
from lio_jax.run.track import CompiledStep, ScanResult, track
from lio_jax.settings.settings import Settings, with_extrinsics, with_overrides
from tests.run import inertial_drive, small_drive
from tests.run.program_cache import kept_programs


@pytest.fixture(scope="package", autouse=True)
def program_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with kept_programs(tmp_path_factory.getbasetemp() / "programs") as cache:
        prepare_jax()
        yield cache


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
