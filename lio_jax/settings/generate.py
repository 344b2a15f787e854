"""Write the shipped settings files and the settings reference from the declarations.

``python -m lio_jax.settings.generate configs/recipes docs/settings.md``
"""

import sys
import textwrap
from pathlib import Path
from typing import Any

import yaml

from lio_jax.core.files import atomic_path
from lio_jax.core.leaf import Setting, choices
from lio_jax.recipes import RECIPES
from lio_jax.settings.settings import declared_settings, recipe_settings
from lio_jax.settings.translate import SYSTEMS

_WIDTH = 110
_HEADER = "| key | unit | default | tuned | meaning |"
_TUNED = {"log": "by its logarithm", "linear": "as it is", "turn": "as a rotation"}


def recipe_file(recipe: str) -> str:
    """Return the text of a recipe's settings file.

    Comments give every value's meaning, its unit, and its name in the program that the recipe follows.
    """
    original = {
        path: f" {system.name}: {key}."
        for system in SYSTEMS
        if system.recipe == recipe
        for key, rule in system.rules.items()
        for path in rule.paths
    }
    lines = [
        f"# Every setting of the recipe {recipe}, with its default. Copy the file, keep the lines that you",
        "# change, and give it to --recipe. Generated from the declarations in the code by 'make settings';",
        "# docs/settings.md lists the settings of all recipes.",
        f"recipe: {recipe}",
    ]
    tree = recipe_settings(recipe).as_dict()
    declared = declared_settings(recipe)
    for kind in ("config", "params"):
        lines.append(f"{kind}:")
        for section, values in tree[kind].items():
            lines.append(f"  {section}:")
            for name, value in values.items():
                setting_path = f"{kind}.{section}.{name}"
                setting = declared[setting_path]
                unit = f" [{setting.declared.unit}]" if setting.declared.unit else ""
                lines += textwrap.wrap(
                    f"{_first_sentence(setting.doc)}{unit}{original.get(setting_path, '')}",
                    _WIDTH,
                    initial_indent="    # ",
                    subsequent_indent="    # ",
                )
                lines.append(f"    {name}: {_written(value)}")
    return "\n".join(lines) + "\n"


def reference() -> str:
    """Return the settings reference of all recipes as Markdown."""
    every = {recipe: declared_settings(recipe) for recipe in RECIPES}
    sections: dict[str, list[str]] = {}
    for settings in every.values():
        for path in settings:
            section, _, name = path.rpartition(".")
            names = sections.setdefault(section, [])
            if name not in names:
                names.append(name)
    text = [
        "# Settings",
        "",
        "Every key of a settings file and of `--set`, generated from the declarations in the code by",
        "`make settings`. `config.*` shapes arrays or chooses code: a change compiles the programs anew.",
        "`params.*` is traced: a change compiles nothing. A recipe takes the keys that it reads alone.",
        "*Tuned* says how `lio-jax tune` varies a parameter; the others have no derivative.",
    ]
    for section in sorted(sections):
        text += ["", f"## {section}", "", _HEADER, "| --- | --- | --- | --- | --- |"]
        for name in sections[section]:
            owners = {r: s[f"{section}.{name}"] for r, s in every.items() if f"{section}.{name}" in s}
            text.append(_row(name, owners))
    return "\n".join(text) + "\n"


def _row(name: str, owners: dict[str, Setting]) -> str:
    setting = next(iter(owners.values()))
    by_value: dict[str, list[str]] = {}
    for recipe, own in owners.items():
        by_value.setdefault(_written(_plain(own.declared.default)), []).append(recipe)
    everywhere = len(owners) == len(RECIPES) and len(by_value) == 1
    defaults = (
        f"`{next(iter(by_value))}`"
        if everywhere
        else "<br>".join(f"`{value}` ({', '.join(recipes)})" for value, recipes in by_value.items())
    )
    tuned = _TUNED.get(setting.declared.tuned or "", "")
    allowed = choices(setting.type)
    listed = f" One of {', '.join(map(str, allowed))}." if allowed else ""
    meaning = (setting.doc + listed).replace("|", "\\|")
    return f"| `{name}` | {setting.declared.unit} | {defaults} | {tuned} | {meaning} |"


def _first_sentence(doc: str) -> str:
    head, dot, rest = doc.partition(". ")
    return head + "." if dot and rest else doc


def _written(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=10**6).removesuffix("...\n").strip()


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def write_all(folder: Path, page: Path) -> None:
    """Write every recipe's file into a folder, and the reference."""
    texts = {folder / f"{recipe}.yaml": recipe_file(recipe) for recipe in RECIPES} | {page: reference()}
    for path, text in texts.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as aside:
            aside.write_text(text)


if __name__ == "__main__":
    write_all(Path(sys.argv[1]), Path(sys.argv[2]))
