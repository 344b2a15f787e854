"""Where the real recordings lie that some tests check against."""

from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

needs_shared = pytest.mark.skipif(
    not SHARED_DATA.is_dir(),
    reason=f"the real recordings are not there ({SHARED_DATA}); nothing is downloaded",
)
