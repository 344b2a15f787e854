"""The command line in this process: one cache of compiled programs for all of its tests."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from lio_jax.cli import main
from tests.run import small_drive
from tests.run.program_cache import kept_programs


@dataclass(frozen=True)
class Done:
    """Output and status of a command."""

    status: int
    out: str
    err: str


Cli = Callable[..., Done]


@pytest.fixture(scope="package", autouse=True)
def program_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with kept_programs(tmp_path_factory.getbasetemp() / "programs") as cache:
        yield cache


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
