"""The command line in this process, and a recording for it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from lio_jax.cli import main
from tests.run import small_drive


@dataclass(frozen=True)
class Done:
    """Output and status of a command."""

    status: int
    out: str
    err: str


Cli = Callable[..., Done]


@pytest.fixture
def cli(capfd: pytest.CaptureFixture[str]) -> Cli:
    """Return a function that runs ``lio-jax`` with words and gives back exit status and output."""

    def run(*words: object) -> Done:
        capfd.readouterr()
        status = main([str(word) for word in words])
        printed = capfd.readouterr()
        return Done(status, printed.out, printed.err)

    return run


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a healthy native recording with truth; not to be changed."""
    return small_drive.write_folder(tmp_path_factory.mktemp("drive") / "drive", small_drive.moving())


PLAIN = ("--set", "config.output.plot=false", "config.output.recording=false", "config.output.report=false")
"""Leaves out the slow files where a test does not look at them."""

NOTES = (
    "note: T_imu_lidar: from the recording's calibration.\n"
    "note: noise of the ranges 0.0211 m, with 0.025 m of surfaces: lidar.range_sigma 0.0327 m.\n"
)
"""All that is said of a run over :func:`folder`, whose ranges have a noise of 0.02 m."""
