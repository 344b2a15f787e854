"""``lio-jax inspect``: a recording's contents, its faults, and the settings that fit it."""

import json
from pathlib import Path

from lio_jax.commands.runtime import say
from lio_jax.core.errors import UsageError
from lio_jax.core.files import atomic_path
from lio_jax.data.detect import open_sequence
from lio_jax.inspection import format_inspection, inspect_sequence, settings_text
from lio_jax.settings.settings import Settings, with_overrides


def inspect(
    data: Path, assignments: tuple[str, ...], as_json: bool, config: Path | None, overwrite: bool
) -> None:
    """Print the results as a table or as one JSON object, and write the settings that fit."""
    if config is not None and config.exists() and not overwrite:
        raise UsageError(f"{config}: exists; choose another file or add --overwrite.")
    settings = with_overrides(Settings(), assignments)
    found = inspect_sequence(open_sequence(data, settings.run.data), settings)
    print(json.dumps(found.to_dict(), allow_nan=False) if as_json else format_inspection(found))
    if config is not None:
        with atomic_path(config) as aside:
            aside.write_text(settings_text(found))
        say(f"note: {config}: for lio-jax run {data} --recipe {config}")
