"""``lio-jax inspect``: what is in a recording, what is wrong with it, which settings fit."""

import json
from pathlib import Path

from lio_jax.core.settings import Settings, with_overrides
from lio_jax.data.inspect import inspect_sequence
from lio_jax.data.inspect_table import format_inspection
from lio_jax.data.open import open_sequence


def inspect(data: Path, assignments: tuple[str, ...], as_json: bool) -> None:
    """Print what was found as a table, or as one JSON object."""
    settings = with_overrides(Settings(), assignments)
    inspection = inspect_sequence(open_sequence(data, settings.config.data))
    print(json.dumps(inspection.to_dict(), allow_nan=False) if as_json else format_inspection(inspection))
