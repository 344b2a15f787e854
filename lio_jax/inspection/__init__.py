"""Examine a recording before the first run."""

from lio_jax.inspection.findings import Inspection, settings_text
from lio_jax.inspection.inspect import inspect_sequence
from lio_jax.inspection.table import format_inspection

__all__ = ["Inspection", "format_inspection", "inspect_sequence", "settings_text"]
