"""Settings of a run: recipe, static config and traced parameters, read from YAML and checked strictly.

A settings file has up to three keys::

recipe: default config: {lidar: {registration_points: 4096}} params: {registration: {kernel: 0.2}}

Paths such as ``params.registration.kernel`` name the same values on the command line. Which paths there are
is what the recipe and the parts of a run declare (:mod:`lio_jax.core.leaf`).
"""

import dataclasses
import difflib
import math
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, get_origin

import numpy as np
import yaml

from lio_jax.core.errors import UsageError
from lio_jax.core.files import parse_yaml, read_text
from lio_jax.core.leaf import Declared, Setting, choices, numbers_of, settings_of, traced
from lio_jax.recipes import RECIPES, AnyRecipe, full_name, recipe_named
from lio_jax.recipes.params import InertialConfig, RecipeConfig, RecipeParams
from lio_jax.settings.shared import GlobalParams, RunConfig

Values = dict[str, dict[str, Any]]
"""Plain numbers by section and name."""


@dataclass(frozen=True)
class Settings:
    """Everything that determines a run apart from its data; without arguments the default recipe's."""

    recipe: str = "default"
    """Name of a recipe, or ``FILE.py:CLASS``."""
    config: RecipeConfig = field(default_factory=lambda: RECIPES["default"].config_type())
    """Static settings of the recipe."""
    run: RunConfig = field(default_factory=RunConfig)
    """Static settings of the reader, the back end and the run folder."""
    values: Values = field(default_factory=lambda: _numbers(RECIPES["default"]))
    """Parameters of the recipe and of the back end as plain numbers."""
    given: frozenset[str] = frozenset()
    """Paths that were set by a file or an override, not by default."""

    def params(self) -> RecipeParams:
        """Return the recipe's traced parameters as a pytree of arrays."""
        return traced(recipe_named(self.recipe).params_type, self.values)

    def with_value(self, path: str, value: Any, source: str) -> "Settings":
        """Return a copy with the value at a path such as ``config.map.capacity`` replaced.

        Args:
            path: as in a settings file, its keys joined by dots.
            value: as YAML reads it.
            source: what the message names when the value is impossible.

        Raises: UsageError: the path is not known (names the nearest), the recipe does not read it, or the
        value is impossible there.
        """
        place = f"{source}: {path}"
        if path == "recipe":
            chosen = full_name(str(value))
            return self if chosen == self.recipe else recipe_settings(chosen)
        known = _paths(recipe_named(self.recipe))
        if path not in known:
            raise UsageError(f"{source}: {_unknown(path, self.recipe)}")
        kind, section, name = path.split(".")
        given = self.given | {path}
        declared = known[path].declared
        if kind == "config":
            checked = _typed(value, known[path].type, place)
            if problem := _sizes_problem(path, checked) or declared.problem(checked):
                raise UsageError(f"{place} = {value!r} {problem}.")
            owner = "config" if hasattr(self.config, section) else "run"
            tree = getattr(self, owner)
            changed = dataclasses.replace(getattr(tree, section), **{name: checked})
            tree = dataclasses.replace(tree, **{section: changed})
            return dataclasses.replace(self, given=given, **{owner: tree})
        checked = _number(value, declared, place)
        if problem := declared.problem(checked):
            raise UsageError(f"{place} = {value!r} {problem}.")
        values = _copied(self.values)
        values[section][name] = checked
        return dataclasses.replace(self, values=values, given=given)

    def as_dict(self) -> dict[str, Any]:
        """Return plain nested values, as they stand in a settings file."""
        config = {
            group.name: {
                f.name: _plain(getattr(getattr(tree, group.name), f.name))
                for f in dataclasses.fields(getattr(tree, group.name))
            }
            for tree in (self.run, self.config)
            for group in dataclasses.fields(tree)
        }
        return {"recipe": self.recipe, "config": config, "params": _copied(self.values)}

    def to_yaml(self) -> str:
        """Return the settings with every value resolved; :func:`settings_from_yaml` reads them back."""
        return yaml.safe_dump(self.as_dict(), sort_keys=False, default_flow_style=None, width=100)

    def __reduce__(self) -> tuple[Any, ...]:
        # a recipe of a user's own file has no module that another process could import
        return _rebuilt, (self.as_dict(), self.given)


def recipe_of(settings: Settings) -> AnyRecipe:
    """Return the recipe that settings name, with their static config."""
    return recipe_named(settings.recipe)(settings.config)


def uses_imu(settings: Settings) -> bool:
    """Return whether the recipe takes inertial samples and is to use them."""
    return isinstance(settings.config, InertialConfig) and settings.config.imu.use


def recipe_settings(recipe: str, source: str = "") -> Settings:
    """Return a recipe's own settings.

    Args:
        recipe: a name, or ``FILE.py:CLASS``.
        source: file that names the recipe, for the message; "": the command line.

    Raises:
        UsageError: there is no such recipe.
    """
    try:
        chosen = recipe_named(recipe)
    except UsageError as error:
        raise UsageError(f"{source}: {error}" if source else str(error)) from error
    settings = Settings(full_name(recipe), chosen.config_type(), RunConfig(), _numbers(chosen))
    for path, value in chosen.given_values.items():
        settings = settings.with_value(path, value, recipe)
    return dataclasses.replace(settings, given=frozenset())


def declared_settings(recipe: str) -> dict[str, Setting]:
    """Return every setting of a run with a recipe by path, such as ``params.map.voxel_size``."""
    return _paths(recipe_named(recipe))


def _rebuilt(tree: dict[str, Any], given: frozenset[str]) -> Settings:
    settings = recipe_settings(tree["recipe"])
    for path, value in _leaves({"config": tree["config"], "params": tree["params"]}, ""):
        settings = settings.with_value(path, value, "settings")
    return dataclasses.replace(settings, given=given)


def _numbers(recipe: type[AnyRecipe]) -> Values:
    return _copied(numbers_of(recipe.params_type) | numbers_of(GlobalParams))


@cache
def _paths(recipe: type[AnyRecipe]) -> dict[str, Setting]:
    """Return the settings of a run with a recipe, by path."""
    found: dict[str, Setting] = {}
    for kind, trees in (
        ("config", (RunConfig, recipe.config_type)),
        ("params", (recipe.params_type, GlobalParams)),
    ):
        for tree in trees:
            found |= {f"{kind}.{path}": setting for path, setting in settings_of(tree).items()}
    return found


def _unknown(path: str, recipe: str) -> str:
    others = [name for name, other in RECIPES.items() if path in _paths(other)]
    if others:
        return f"the recipe {recipe} does not read '{path}' ({', '.join(others)} do); leave it out."
    return f"unknown key '{path}'; {_nearest(path, recipe)}"


def _sizes_problem(path: str, value: Any) -> str:
    if path.endswith(".buckets") and (sorted(set(value)) != list(value) or value[0] < 1):
        return "must be positive sizes in ascending order"
    return ""


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
        tree = parse_yaml(text)
    except ValueError as error:
        raise UsageError(f"{source}: not valid YAML ({error}).") from None
    if tree is None:
        return base or Settings()
    if not isinstance(tree, dict):
        raise UsageError(f"{source}: expected keys 'recipe', 'config' and 'params', found {tree!r}.")
    settings = base or recipe_settings(str(tree.get("recipe", Settings.recipe)), source)
    for path, value in _leaves(tree, source):
        settings = settings.with_value(path, value, source)
    return checked_together(settings, source)


def load_settings(path: Path, base: Settings | None = None) -> Settings:
    """Read a settings file; see :func:`settings_from_yaml`."""
    try:
        text = read_text(path, "give a YAML settings file", UsageError)
    except OSError as error:
        raise UsageError(f"{path}: the settings file cannot be read ({error.strerror}).") from None
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
            parsed = parse_yaml(value)
        except ValueError:
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
    features = getattr(settings.config, "features", None)
    if features and 0 < features.columns <= 2 * features.neighbours:
        raise UsageError(
            f"{source}: config.features.columns ({features.columns}) must be more than twice "
            f"config.features.neighbours ({features.neighbours})."
        )
    return settings


def _copied(values: Values) -> Values:
    return {
        section: {name: list(value) if isinstance(value, list) else value for name, value in leaves.items()}
        for section, leaves in values.items()
    }


def _leaves(tree: dict[Any, Any], source: str, prefix: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for key, value in tree.items():
        path = f"{prefix}{key}"
        if isinstance(value, dict):
            found += _leaves(value, source, f"{path}.")
        elif any(known.startswith(f"{path}.") for known in every_path()):
            if value is not None:
                raise UsageError(
                    f"{source}: {path} = {value!r} must hold keys, for example {_example(path)}."
                )
        else:
            found.append((path, value))
    return found


@cache
def every_path() -> frozenset[str]:
    """Return the paths that any recipe of the package reads."""
    return frozenset(path for recipe in RECIPES.values() for path in _paths(recipe))


def _example(path: str) -> str:
    return next(known for known in sorted(every_path()) if known.startswith(f"{path}."))


def _nearest(path: str, recipe: str) -> str:
    known = ["recipe", *_paths(recipe_named(recipe))]
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
    if allowed := choices(kind):
        if isinstance(value, bool):  # YAML 1.1 reads yes and no as booleans
            value = "yes" if value else "no"
        if value not in allowed:
            raise UsageError(f"{place} = {value!r} must be one of {', '.join(map(str, allowed))}.")
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


def _number(value: Any, declared: Declared, place: str) -> Any:
    """Return ``value`` as a number or a list: of as many numbers as the default has, or one for each ring."""
    if isinstance(declared.default, tuple):
        length = len(declared.default)
        numbers = [_as_float(item) for item in value] if isinstance(value, list | tuple) else None
        if numbers is None or None in numbers or not (declared.per_ring or len(numbers) == length):
            wanted = "with one number per ring" if declared.per_ring else f"of {length} numbers"
            raise UsageError(f"{place} = {value!r} must be a list {wanted}.")
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
