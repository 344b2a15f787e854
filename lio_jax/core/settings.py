"""Settings of a run: recipe name, static config and traced parameters, read from YAML and checked strictly.

A settings file has up to three keys::

    recipe: default
    config: {lidar: {registration_points: 4096}}
    params: {registration: {kernel: 0.2}}

Paths such as ``params.registration.kernel`` name the same values on the command line.
"""

import dataclasses
import difflib
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import yaml

from lio_jax.core.config import Config, invalid_config
from lio_jax.core.errors import UsageError
from lio_jax.core.param_values import DEFAULTS, invalid_value
from lio_jax.core.params import Params, params_from_values
from lio_jax.core.recipe_values import RECIPE_VALUES


@dataclass(frozen=True)
class Settings:
    """Everything that determines a run beside its data."""

    recipe: str = "default"
    config: Config = field(default_factory=Config)
    values: dict[str, dict[str, Any]] = field(default_factory=lambda: _copied(DEFAULTS))
    """Traced parameters as plain numbers by section and name."""
    given: frozenset[str] = frozenset()
    """Paths that were set by a file or an override, not by default."""

    def params(self) -> Params:
        """Return the traced parameters as a pytree."""
        return params_from_values(self.values)

    def with_value(self, path: str, value: Any, source: str) -> "Settings":
        """Return a copy with the value at a path such as ``config.map.capacity`` replaced.

        Raises:
            UsageError: the path is not known (names the nearest), or the value is impossible there.
        """
        place = f"{source}: {path}"
        if path == "recipe":
            return dataclasses.replace(self, recipe=str(value))
        if path not in _PATHS:
            raise UsageError(f"{source}: unknown key '{path}'; {_nearest(path)}")
        kind, section, *rest = path.split(".")
        name = ".".join(rest)
        given = self.given | {path}
        if kind == "config":
            group = getattr(self.config, section)
            checked = _typed(value, _PATHS[path], place)
            if problem := invalid_config(path, checked):
                raise UsageError(f"{place} = {value!r} {problem}.")
            config = dataclasses.replace(
                self.config, **{section: dataclasses.replace(group, **{name: checked})}
            )
            return dataclasses.replace(self, config=config, given=given)
        default = DEFAULTS[section][name]
        checked = _number(value, default, place)
        if problem := invalid_value(f"{section}.{name}", checked):
            raise UsageError(f"{place} = {value!r} {problem}.")
        values = _copied(self.values)
        values[section][name] = checked
        return dataclasses.replace(self, values=values, given=given)

    def as_dict(self) -> dict[str, Any]:
        """Return plain nested values, as they stand in a settings file."""
        config = {
            group.name: {
                f.name: _plain(getattr(getattr(self.config, group.name), f.name))
                for f in dataclasses.fields(getattr(self.config, group.name))
            }
            for group in dataclasses.fields(self.config)
        }
        return {"recipe": self.recipe, "config": config, "params": _copied(self.values)}

    def to_yaml(self) -> str:
        """Return the settings with every value resolved; :func:`settings_from_yaml` reads them back."""
        return yaml.safe_dump(self.as_dict(), sort_keys=False, default_flow_style=None, width=100)


def recipe_settings(recipe: str) -> Settings:
    """Return a recipe's own settings: the defaults with the values in which it differs."""
    settings = Settings(recipe=recipe)
    for path, value in RECIPE_VALUES.get(recipe, {}).items():
        settings = settings.with_value(path, value, recipe)
    return dataclasses.replace(settings, given=frozenset())


def settings_from_yaml(text: str, source: str, base: Settings | None = None) -> Settings:
    """Read settings on top of ``base``; where it is not given, of the text's recipe's own settings.

    Args:
        text: YAML.
        source: file name for messages.
        base: settings that hold where the text says nothing.

    Raises:
        UsageError: not YAML, an unknown key or an impossible value; the message names file and key.
    """
    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise UsageError(f"{source}: not valid YAML ({reason}).") from None
    if tree is None:
        return base or Settings()
    if not isinstance(tree, dict):
        raise UsageError(f"{source}: expected keys 'recipe', 'config' and 'params', found {tree!r}.")
    settings = base or recipe_settings(str(tree.get("recipe", Settings.recipe)))
    for path, value in _leaves(tree, source):
        settings = settings.with_value(path, value, source)
    return checked_together(settings, source)


def load_settings(path: Path, base: Settings | None = None) -> Settings:
    """Read a settings file; see :func:`settings_from_yaml`."""
    try:
        text = path.read_text()
    except OSError as error:
        raise UsageError(f"{path}: the settings file cannot be read ({error.strerror}).") from None
    except UnicodeDecodeError:
        raise UsageError(f"{path}: is not a text file; give a YAML settings file.") from None
    return settings_from_yaml(text, str(path), base)


def with_overrides(settings: Settings, assignments: list[str] | tuple[str, ...]) -> Settings:
    """Apply ``path=value`` strings, the value written as YAML.

    Raises:
        UsageError: an assignment has no '=', or as for a file.
    """
    for assignment in assignments:
        path, equals, value = assignment.partition("=")
        if not equals:
            raise UsageError(
                f"--set {assignment}: write it as path=value, for example config.map.capacity=65536."
            )
        if path.strip() == "recipe":
            raise UsageError("--set recipe: choose the recipe by --recipe, because it brings its own values.")
        try:
            parsed = yaml.safe_load(value)
        except yaml.YAMLError:
            raise UsageError(f"--set {path}: the value {value!r} is not valid YAML.") from None
        settings = settings.with_value(path.strip(), parsed, "--set")
    return checked_together(settings, "--set") if assignments else settings


def checked_together(settings: Settings, source: str) -> Settings:
    """Return the settings if values that depend on each other fit.

    Raises:
        UsageError: they do not.
    """
    lidar = settings.values["lidar"]
    if lidar["min_range"] >= lidar["max_range"]:
        raise UsageError(
            f"{source}: params.lidar.min_range ({lidar['min_range']}) must be below "
            f"params.lidar.max_range ({lidar['max_range']})."
        )
    features = settings.config.features
    if 0 < features.columns <= 2 * features.neighbours:
        raise UsageError(
            f"{source}: config.features.columns ({features.columns}) must be more than twice "
            f"config.features.neighbours ({features.neighbours})."
        )
    return settings


def _copied(values: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {
        section: {name: list(value) if isinstance(value, list) else value for name, value in leaves.items()}
        for section, leaves in values.items()
    }


def _leaf_types() -> dict[str, Any]:
    paths: dict[str, Any] = {}
    for group in dataclasses.fields(Config):
        for leaf in dataclasses.fields(group.type):  # type: ignore[arg-type]
            paths[f"config.{group.name}.{leaf.name}"] = leaf.type
    for section, leaves in DEFAULTS.items():
        for name in leaves:
            paths[f"params.{section}.{name}"] = float
    return paths


_PATHS = _leaf_types()


def _leaves(tree: dict[Any, Any], source: str, prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in tree.items():
        path = f"{prefix}{key}"
        if isinstance(value, dict):
            found += _leaves(value, source, f"{path}.")
        elif any(known.startswith(f"{path}.") for known in _PATHS):
            if value is not None:
                raise UsageError(
                    f"{source}: {path} = {value!r} must hold keys, for example {_example(path)}."
                )
        else:
            found.append((path, value))
    return found


def _example(path: str) -> str:
    return next(known for known in _PATHS if known.startswith(f"{path}."))


def _nearest(path: str) -> str:
    known = ["recipe", *_PATHS]
    by_name = {candidate.rsplit(".", 1)[-1]: candidate for candidate in known}
    close = difflib.get_close_matches(path, known, 1, 0.75)
    if not close:
        close = [
            by_name[name] for name in difflib.get_close_matches(path.rsplit(".", 1)[-1], by_name, 1, 0.6)
        ]
    close = close or difflib.get_close_matches(path, known, 1, 0.0)
    return f"did you mean '{close[0]}'?"


def _typed(value: Any, kind: Any, place: str) -> Any:
    """Return ``value`` as the config field's type, or say what was expected."""
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        if isinstance(value, bool):  # YAML 1.1 reads yes and no as booleans
            value = "yes" if value else "no"
        if value not in choices:
            raise UsageError(f"{place} = {value!r} must be one of {', '.join(map(str, choices))}.")
        return value
    if get_origin(kind) is tuple:
        if not isinstance(value, list | tuple) or not value:
            raise UsageError(
                f"{place} = {value!r} must be a list of whole numbers, for example [8192, 16384]."
            )
        return tuple(_typed(item, int, place) for item in value)
    if kind is bool and isinstance(value, bool):
        return value
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind is float and (number := _as_float(value)) is not None:
        return number
    if kind is str and (isinstance(value, str) or value is None):
        return value or ""
    wanted = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
    raise UsageError(f"{place} = {value!r} must be {wanted[kind]}.")


def _number(value: Any, default: Any, place: str) -> Any:
    """Return ``value`` as a number or a list of as many numbers as the default has."""
    if isinstance(default, list):
        numbers = [_as_float(item) for item in value] if isinstance(value, list | tuple) else []
        if len(numbers) != len(default) or any(number is None for number in numbers):
            raise UsageError(f"{place} = {value!r} must be a list of {len(default)} numbers.")
        return numbers
    number = _as_float(value)
    if number is None:
        raise UsageError(f"{place} = {value!r} must be a number.")
    return number


def _as_float(value: Any) -> float | None:
    # YAML 1.1 reads 1e-3 as text
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def with_extrinsics(settings: Settings, T_imu_lidar: np.ndarray, source: str) -> Settings:
    """Return the settings with params.extrinsics taken from a 4x4 T_imu_lidar."""
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(T_imu_lidar[:3, :3]).as_quat().tolist()
    settings = settings.with_value("params.extrinsics.rotation", quaternion, source)
    return settings.with_value("params.extrinsics.translation", T_imu_lidar[:3, 3].tolist(), source)
