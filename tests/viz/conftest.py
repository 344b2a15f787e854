"""Where the pictures go that tests take of pages: for people to look at."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def pictures() -> Path:
    """Return a folder that remains, apart from the runs' own results and outside the repository."""
    folder = Path(__file__).parents[2] / "out" / "test-pictures"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
