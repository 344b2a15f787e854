"""One cache of compiled programs for all tests of ablations, worker processes included."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.run.program_cache import kept_programs


@pytest.fixture(scope="package", autouse=True)
def program_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with kept_programs(tmp_path_factory.getbasetemp() / "programs") as cache:
        yield cache
