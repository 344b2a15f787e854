"""The recipes: pure step functions that read like the block diagrams of the systems they stand for."""

import hashlib
import importlib.util
import inspect
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from lio_jax.core.errors import UsageError
from lio_jax.recipes.default import Default
from lio_jax.recipes.fast_lio2 import FastLio2
from lio_jax.recipes.lio_sam import LioSam
from lio_jax.recipes.loam import Loam
from lio_jax.recipes.recipe import Recipe

AnyRecipe = Recipe[Any, Any, Any]

RECIPES: dict[str, type[AnyRecipe]] = {
    "default": Default,
    "fast_lio2": FastLio2,
    "lio_sam": LioSam,
    "loam": Loam,
}


def recipe_named(name: str) -> type[AnyRecipe]:
    """Return a recipe's class.

    Args:
        name: of a recipe, or ``FILE.py:CLASS`` for a recipe in a file of one's own.

    Raises:
        UsageError: there is none of that name (lists those there are), or the file or the class is no recipe.
    """
    if name in RECIPES:
        return RECIPES[name]
    file, colon, attribute = name.rpartition(":")
    if not colon or not file.endswith(".py"):
        raise UsageError(
            f"recipe '{name}' is not known; there are: {', '.join(RECIPES)}; or give a settings file *.yaml, "
            "or FILE.py:CLASS for a recipe of your own."
        )
    found = getattr(_module_of(file), attribute, None)
    if not (inspect.isclass(found) and issubclass(found, Recipe)):
        raise UsageError(f"{file}: holds no recipe '{attribute}' (a subclass of lio_jax.Recipe).")
    if missing := sorted(found.__abstractmethods__):
        raise UsageError(f"{file}: the recipe '{attribute}' lacks {' and '.join(missing)}.")
    for needed in ("config_type", "params_type"):
        if not inspect.isclass(getattr(found, needed, None)):
            raise UsageError(f"{file}: the recipe '{attribute}' lacks {needed} (a class of sections).")
    return found


def full_name(name: str) -> str:
    """Return a recipe's name with the absolute path of its file, so that it is found from any folder."""
    file, colon, attribute = name.rpartition(":")
    return f"{Path(file).resolve()}:{attribute}" if colon and file.endswith(".py") else name


def source_hash(name: str) -> str:
    """Return a hash of a recipe file's text; nothing for a recipe of the package."""
    file, colon, _ = name.rpartition(":")
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if colon else ""


def _module_of(file: str) -> ModuleType:
    path = Path(file).resolve()
    try:
        text = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{file}: the recipe's file cannot be read ({error.strerror}).") from None
    return _loaded(path, hashlib.sha256(text).hexdigest())


@cache
def _loaded(path: Path, version: str) -> ModuleType:
    """Return a file as a module: the same one as long as its text is the same, as programs are kept by
    class."""
    name = f"lio_jax_recipe_{version[:16]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # dataclasses look their module up by name
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        where = f"{type(error).__name__}: {error}"
        raise UsageError(f"{path}: the recipe's file cannot be imported ({where}).") from error
    return module
