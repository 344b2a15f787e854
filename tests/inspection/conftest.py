"""One cache of compiled programs for all inspections of this process."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from lio_jax.commands.runtime import prepare_jax
from tests.run.program_cache import kept_programs


@pytest.fixture(scope="package", autouse=True)
def program_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with kept_programs(tmp_path_factory.getbasetemp() / "programs") as cache:
        prepare_jax()
        yield cache
