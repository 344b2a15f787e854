"""The settings that an ablation compares: a grid, zipped lists, random draws, or a list of overrides."""

import itertools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lio_jax.core.errors import UsageError
from lio_jax.settings.settings import (
    Settings,
    checked_together,
    declared_settings,
    every_path,
    load_settings,
    recipe_settings,
)

Overrides = dict[str, Any]


@dataclass(frozen=True)
class Variant:
    """One set of settings in the comparison."""

    name: str
    """Short name for tables."""
    overrides: Overrides
    """Settings that the ablation changes: ``recipe``, ``config.*`` and ``params.*``."""
    settings: Settings


def overrides_of(tree: Mapping[str, Any], place: str) -> list[tuple[str, Overrides]]:
    """Return all overrides of a specification, each with its given name, or "".

    Args:
        tree: mapping with any of the keys grid, zip, random and list; their overrides are concatenated.
        place: file name in messages.

    Raises:
        UsageError: there is nothing to compare, or a key holds no values.
    """
    found: list[tuple[str, Overrides]] = []
    for kind in KINDS:
        if kind in tree:
            found += _READERS[kind](tree[kind], f"{place}: {kind}")
    if not found:
        raise UsageError(
            f"{place}: nothing to compare; give grid, zip, random or list, "
            "for example grid: {params.map.voxel_size: [0.8, 1.2]}."
        )
    return found


def variants(
    wanted: Iterable[tuple[str, Overrides]], recipe: str, common: Overrides, folder: Path, place: str
) -> list[Variant]:
    """Resolve overrides into settings; equal settings are taken once.

    Args:
        wanted: names and overrides.
        recipe: recipe or settings file to which the overrides apply.
        common: overrides that apply to all variants.
        folder: folder in which settings files are looked for first.
        place: file name in messages.
    """
    wanted = list(wanted)
    paths = list(dict.fromkeys(path for _, overrides in wanted for path in overrides))
    short = _short_names(paths)
    found: dict[str, Variant] = {}
    for name, overrides in wanted:
        settings = _settings(recipe, common, overrides, folder, place)
        words = [f"{short[path]}={_word(value)}" for path, value in overrides.items()]
        label = name or " ".join(words) or Path(recipe).stem
        identity = json.dumps(settings.as_dict()) + repr(sorted(settings.given))
        found.setdefault(identity, Variant(label, overrides, settings))
    names = [variant.name for variant in found.values()]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise UsageError(f"{place}: two different entries are named '{twice}'; give each a name of its own.")
    return list(found.values())


def _settings(recipe: str, common: Overrides, overrides: Overrides, folder: Path, place: str) -> Settings:
    chosen = str((common | overrides).get("recipe", recipe))
    if chosen.endswith((".yaml", ".yml")):
        relative = folder / chosen
        settings = load_settings(relative if relative.exists() else Path(chosen))
    else:
        file, colon, _ = chosen.rpartition(":")
        # a recipe in a file is looked for next to the specification first
        beside_spec = bool(colon) and (folder / file).is_file()
        settings = recipe_settings(str(folder / chosen) if beside_spec else chosen, place)
    # what is set for all variants holds for those whose recipe reads it
    known = declared_settings(settings.recipe)
    elsewhere = every_path() - set(known)
    shared = {path: value for path, value in common.items() if path not in elsewhere}
    for path, value in (shared | overrides).items():
        if path != "recipe":
            settings = settings.with_value(path, value, place)
    return checked_together(settings, place)


def _grid(tree: Any, place: str) -> list[tuple[str, Overrides]]:
    axes = _axes(tree, place)
    return [("", dict(zip(axes, values, strict=True))) for values in itertools.product(*axes.values())]


def _zip(tree: Any, place: str) -> list[tuple[str, Overrides]]:
    axes = _axes(tree, place)
    lengths = {len(values) for values in axes.values()}
    if len(lengths) != 1:
        each = ", ".join(f"{path} {len(values)}" for path, values in axes.items())
        raise UsageError(f"{place}: all keys need as many values as each other, not {each}.")
    return [("", dict(zip(axes, values, strict=True))) for values in zip(*axes.values(), strict=True)]


def _list(tree: Any, place: str) -> list[tuple[str, Overrides]]:
    if not isinstance(tree, list) or not tree:
        raise UsageError(f"{place}: must hold at least one set of overrides, such as - {{recipe: loam}}.")
    found = []
    for number, entry in enumerate(tree):
        if not isinstance(entry, dict):
            raise UsageError(f"{place}: entry {number + 1} is {entry!r}; write it as {{path: value, ...}}.")
        rest = {str(path): value for path, value in entry.items() if path != "name"}
        found.append((str(entry.get("name", "")), rest))
    return found


def _random(tree: Any, place: str) -> list[tuple[str, Overrides]]:
    if not isinstance(tree, dict):
        raise UsageError(f"{place}: must hold count, seed and ranges, not {tree!r}.")
    count, seed = tree.get("count", 0), tree.get("seed", 0)
    if not isinstance(count, int) or count < 1:
        raise UsageError(f"{place}: count = {count!r} must be a whole number of at least 1.")
    ranges = {str(path): value for path, value in tree.items() if path not in ("count", "seed")}
    if not ranges:
        raise UsageError(
            f"{place}: nothing is drawn; give ranges, such as params.map.voxel_size: {{uniform: [0.5, 2]}}."
        )
    draw = np.random.default_rng(seed)
    return [
        ("", {path: _drawn(draw, value, f"{place}: {path}") for path, value in ranges.items()})
        for _ in range(count)
    ]


def _drawn(draw: np.random.Generator, given: Any, place: str) -> Any:
    if isinstance(given, dict) and len(given) == 1:
        kind, values = next(iter(given.items()))
        if kind == "choice" and isinstance(values, list) and values:
            return values[int(draw.integers(len(values)))]
        try:
            low, high = (float(value) for value in values)
        except (TypeError, ValueError):
            low, high = 1.0, 0.0
        if kind == "uniform" and low <= high:
            return float(draw.uniform(low, high))
        if kind == "log_uniform" and 0 < low <= high:
            return float(np.exp(draw.uniform(np.log(low), np.log(high))))
    raise UsageError(
        f"{place} = {given!r} must be {{uniform: [low, high]}}, {{log_uniform: [low, high]}} or "
        "{choice: [a, b, ...]}."
    )


_READERS = {"grid": _grid, "zip": _zip, "random": _random, "list": _list}
KINDS = tuple(_READERS)
"""Keys of a specification that define what is compared."""


def _axes(tree: Any, place: str) -> dict[str, list[Any]]:
    if not isinstance(tree, dict) or not tree:
        raise UsageError(
            f"{place}: is empty; give keys with lists, such as params.map.voxel_size: [0.8, 1.2]."
        )
    for path, values in tree.items():
        if not isinstance(values, list) or not values:
            raise UsageError(f"{place}: {path} = {values!r} must be a list with at least one value.")
    return {str(path): values for path, values in tree.items()}


def _short_names(paths: list[str]) -> dict[str, str]:
    """Return the shortest ends of the paths that are unique."""
    short = {}
    for path in paths:
        parts = path.split(".")
        ends = [".".join(parts[-length:]) for length in range(1, len(parts) + 1)]
        short[path] = next(
            end
            for end in ends
            if end == path or not any(other != path and f".{other}".endswith(f".{end}") for other in paths)
        )
    return short


def _word(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.4g}" if isinstance(value, float) else str(value).replace(" ", "")
