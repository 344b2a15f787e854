"""Read a parameter file of LIO-SAM or FAST-LIO2 into this project's names, units and conventions.

Files of ROS 1 (``lio_sam: {...}``) and of ROS 2 (``/**: {ros__parameters: {...}}``) are read. Settings of the
sensors apply to every recipe. Settings of the system's own method apply only to the recipe that follows it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lio_jax.core.errors import UsageError
from lio_jax.core.files import parse_yaml, read_text
from lio_jax.settings.foreign_rules import Rule, System
from lio_jax.settings.from_fast_lio2 import FAST_LIO2
from lio_jax.settings.from_lio_sam import LIO_SAM
from lio_jax.settings.settings import Settings, checked_together, declared_settings

SYSTEMS = (LIO_SAM, FAST_LIO2)

_NAMES = " or ".join(system.name for system in SYSTEMS)
_PARAMETERS = "ros__parameters"


@dataclass(frozen=True)
class ForeignKey:
    """One key of the file, and how it was understood."""

    key: str
    """Name of the key in the file, sections joined by dots."""
    value: Any
    """Value of the key in the file."""
    settings: Mapping[str, Any]
    """This project's settings by path; empty: there is no counterpart."""
    word: str
    """Remark on the conversion, or on why there is no counterpart."""
    method: bool
    """Whether the key belongs to the system's own method: other recipes do not take it."""


@dataclass(frozen=True)
class ForeignSettings:
    """All keys of one parameter file."""

    source: str
    """The file's name."""
    system: System
    keys: tuple[ForeignKey, ...]

    def taken(self, recipe: str) -> tuple[ForeignKey, ...]:
        """Return the keys whose settings a recipe reads."""
        known = declared_settings(recipe)
        return tuple(
            key
            for key in self.keys
            if key.settings
            and (recipe == self.system.recipe or not key.method)
            and all(path in known for path in key.settings)
        )

    def applied_to(self, settings: Settings) -> Settings:
        """Return the settings with those values of the file that their recipe takes.

        Raises:
            UsageError: a value is impossible; the message names file and key.
        """
        for entry in self.taken(settings.recipe):
            for path, value in entry.settings.items():
                settings = settings.with_value(path, value, f"{self.source}: {entry.key}")
        return checked_together(settings, self.source)


def load_foreign_settings(path: Path) -> ForeignSettings:
    """Read a parameter file of another system.

    Raises:
        UsageError: unreadable, of a system unknown here, without its sections, or with an impossible value;
            the message names file and key.
    """
    try:
        text = read_text(path, "give a YAML parameter file", UsageError)
    except OSError as error:
        raise UsageError(f"{path}: the parameter file cannot be read ({error.strerror}).") from None
    return foreign_settings_from_yaml(text, str(path))


def foreign_settings_from_yaml(text: str, source: str) -> ForeignSettings:
    """Read the text of a parameter file; see :func:`load_foreign_settings`.

    Args:
        text: the file's text, YAML.
        source: file name in messages.
    """
    values, section = _parameters(_parsed(text, source), source)
    found = {system: sum(_name(key) in system.rules for key in values) for system in SYSTEMS}
    system = max(SYSTEMS, key=lambda each: found[each])
    if not found[system]:
        raise UsageError(
            f"{source}: holds no parameters of {_NAMES}; a settings file of this project goes to --recipe."
        )
    if system is LIO_SAM and not section:
        raise UsageError(
            f"{source}: the section 'lio_sam:' (ROS 1) or '{_PARAMETERS}:' (ROS 2) around "
            f"{system.name}'s parameters is missing."
        )
    for needed in system.sections:
        if not any(key.startswith(f"{needed}.") for key in values):
            raise UsageError(
                f"{source}: the section '{needed}' is missing; a {system.name} file has "
                f"{', '.join(system.sections)}."
            )
    by_name = {_name(key): value for key, value in values.items()}
    keys = []
    for key, value in values.items():
        rule = _rule(system, key)
        settings, word = rule.take(value, f"{source}: {key}", by_name)
        keys.append(ForeignKey(key, value, settings, word, rule.method))
    return ForeignSettings(source, system, tuple(keys))


def _rule(system: System, key: str) -> Rule:
    section = key.partition(".")[0]
    unknown = Rule(lambda *_: ({}, f"not a parameter of {system.name} that is known here"))
    return system.other_sections.get(section) or system.rules.get(_name(key), unknown)


def _name(key: str) -> str:
    # forks move parameters between sections; the names are unique without the sections
    return key.rpartition(".")[2]


def _parsed(text: str, source: str) -> Any:
    if text.startswith("%YAML:1.0") or "!!opencv-matrix" in text:
        raise UsageError(
            f"{source}: is an OpenCV file (%YAML:1.0, !!opencv-matrix), which is not read; write the "
            f"matrices as plain lists in a parameter file of {_NAMES}."
        )
    try:
        return parse_yaml(text)
    except ValueError as error:
        raise UsageError(f"{source}: not valid YAML ({error}).") from None


def _parameters(tree: Any, source: str) -> tuple[dict[str, Any], str]:
    """Return the values by dotted key, and the name of the section around them; "" if there is none."""
    if not isinstance(tree, dict):
        raise UsageError(f"{source}: expected parameters by name, found {tree!r}.")
    dicts = {name: node for name, node in tree.items() if isinstance(node, dict)}
    nodes = {name: node[_PARAMETERS] for name, node in dicts.items() if _PARAMETERS in node}
    if nodes:
        values: dict[str, Any] = {}
        for name, parameters in nodes.items():
            values |= _flat(_section(parameters, f"{source}: {name}.{_PARAMETERS}"))
        return values, _PARAMETERS
    if "lio_sam" in tree:
        return _flat(_section(tree["lio_sam"], f"{source}: lio_sam")), "lio_sam"
    return _flat(tree), ""


def _section(value: Any, place: str) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise UsageError(f"{place} = {value!r} must hold parameters by name.")
    return value


def _flat(tree: dict[Any, Any], prefix: str = "") -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in tree.items():
        values |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return values
