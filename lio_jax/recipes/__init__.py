"""The recipes: pure step functions that read like the block diagrams of the systems they stand for."""

from types import ModuleType

from lio_jax.core.errors import UsageError
from lio_jax.recipes import default, fast_lio2, lio_sam, loam

RECIPES: dict[str, ModuleType] = {
    "default": default,
    "fast_lio2": fast_lio2,
    "lio_sam": lio_sam,
    "loam": loam,
}
"""By name; each module has State, Output, init(config, params, imu), step(config, params, state, scan, imu)
and with_velocity_of(fresh, found), which gives a first state the motion of a later one: a vehicle that is
already moving distorts its first scan, which nothing can compensate until the second."""


def recipe_named(name: str) -> ModuleType:
    """Return a recipe's module.

    Raises:
        UsageError: there is none of that name (lists those there are).
    """
    if name not in RECIPES:
        raise UsageError(
            f"recipe '{name}' is not known; there are: {', '.join(RECIPES)}; or give a settings file *.yaml."
        )
    return RECIPES[name]
