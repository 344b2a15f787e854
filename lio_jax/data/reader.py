"""What a reader of recordings declares, so that :mod:`lio_jax.data.detect` can choose it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lio_jax.core.errors import LioJaxError
from lio_jax.data.config import DataConfig
from lio_jax.data.sequence import Sequence


@dataclass(frozen=True)
class Reader:
    """One format of recordings."""

    name: str
    """As it stands in ``SequenceInfo.format``."""
    called: str
    """In messages, with what it is recognised by: "a native folder (meta.yaml and scans/)"."""
    recognises: Callable[[Path], bool]
    """Whether an existing path looks like such a recording."""
    open: Callable[[Path, DataConfig], Sequence]
    """Opens it; raises LioJaxError where it is broken."""
    has_parts: bool = True
    """Whether the paths inside such a recording are parts of it and no recordings themselves."""


def entries(folder: Path) -> list[Path]:
    """Return what lies in a folder, in order, hidden files left out.

    Raises:
        LioJaxError: the folder cannot be listed.
    """
    try:
        return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise LioJaxError(f"{folder}: cannot be listed ({error.strerror}); check its permissions.") from None
