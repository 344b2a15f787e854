"""The recipes: pure step functions that read like the block diagrams of the systems they stand for."""

from typing import Any

from lio_jax.core.errors import UsageError
from lio_jax.core.settings import Settings
from lio_jax.recipes.default import Default
from lio_jax.recipes.fast_lio2 import FastLio2
from lio_jax.recipes.lio_sam import LioSam
from lio_jax.recipes.loam import Loam
from lio_jax.recipes.recipe import Recipe

RECIPES: dict[str, type[Recipe[Any, Any, Any]]] = {
    "default": Default,
    "fast_lio2": FastLio2,
    "lio_sam": LioSam,
    "loam": Loam,
}


def recipe_named(name: str) -> type[Recipe[Any, Any, Any]]:
    """Return a recipe's class.

    Raises:
        UsageError: there is none of that name (lists those there are).
    """
    if name not in RECIPES:
        raise UsageError(
            f"recipe '{name}' is not known; there are: {', '.join(RECIPES)}; or give a settings file *.yaml."
        )
    return RECIPES[name]


def recipe_of(settings: Settings) -> Recipe[Any, Any, Any]:
    """Return the recipe that settings name, with their static config."""
    return recipe_named(settings.recipe)(settings.config)
