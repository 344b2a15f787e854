"""``--params-from``: settings from a parameter file of LIO-SAM or FAST-LIO2, and what became of its keys."""

from pathlib import Path
from typing import Any

from lio_jax.core.settings import Settings, load_settings, recipe_settings
from lio_jax.data.foreign_settings import ForeignKey, ForeignSettings


def beneath_recipe(foreign: ForeignSettings, recipe: str | None, is_file: bool) -> Settings:
    """Return a recipe's settings with another system's on top, and a settings file's on top of those.

    Args:
        foreign: the other system's.
        recipe: name or settings file; None: the recipe that stands for the system. So does a file that names
            none.
        is_file: whether ``recipe`` is a file.

    Raises:
        UsageError: a file is unreadable, or holds an unknown key or an impossible value.
    """
    if not is_file:
        return foreign.applied_to(recipe_settings(recipe or foreign.system.recipe))
    file = Path(str(recipe))
    named = load_settings(file, recipe_settings(foreign.system.recipe)).recipe
    return load_settings(file, foreign.applied_to(recipe_settings(named)))


def mapping_table(foreign: ForeignSettings, settings: Settings) -> str:
    """Write each key of the file with what became of it in a run's settings."""
    system, recipe = foreign.system, settings.recipe
    taken = foreign.taken(recipe)
    left = [entry for entry in foreign.keys if entry not in taken]
    width = max(len(entry.key) for entry in foreign.keys)
    lines = [f"{foreign.source}: {system.name}'s parameters, recipe {recipe}"]
    for entry in taken:
        lines.append(
            f"  {entry.key:{width}}  {_short(entry.value)} -> {_ours(entry, settings)}{_said(entry.word)}"
        )
    if left:
        lines.append("not taken:")
    for entry in left:
        why = f"of {system.name}'s method, not taken by the recipe {recipe}" if entry.settings else entry.word
        lines.append(f"  {entry.key:{width}}  {_short(entry.value)}{_said(why)}")
    return "\n".join(lines)


def _ours(entry: ForeignKey, settings: Settings) -> str:
    words = []
    for path, value in entry.settings.items():
        kind, section, name = path.split(".")
        final = settings.as_dict()[kind][section][name]
        replaced = f" (replaced: {_short(final)})" if final != _as_held(value, final) else ""
        words.append(f"{path}={_short(value)}{replaced}")
    return ", ".join(words)


def _as_held(value: Any, final: Any) -> Any:
    if isinstance(final, str):
        return value or ""
    return float(value) if isinstance(final, float) else value


def _said(word: str) -> str:
    return f"  ({word})" if word else ""


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return f"[{','.join(_short(item) for item in value)}]"
    return str(value)
