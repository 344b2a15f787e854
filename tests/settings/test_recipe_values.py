"""Each recipe's own values: by name, by file, and beneath a file's and the command line's."""

from pathlib import Path

import pytest

from lio_jax.commands.run import resolve_settings
from lio_jax.core.errors import UsageError
from lio_jax.recipes import RECIPES
from lio_jax.settings.generate import recipe_file, reference
from lio_jax.settings.settings import (
    Settings,
    load_settings,
    recipe_settings,
    settings_from_yaml,
    with_overrides,
)

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "recipes"


def value_at(settings: Settings, path: str):
    place = settings.as_dict()
    for key in path.split("."):
        place = place[key]
    return place


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_name_stands_for_its_values_and_nothing_counts_as_given(recipe):
    settings = recipe_settings(recipe)
    assert settings.recipe == recipe
    assert settings.given == frozenset()


def test_each_recipe_has_the_values_of_the_system_it_stands_for():
    known = {
        "fast_lio2": {"params.map.voxel_size": 0.5, "params.imu.gyro_noise": (0.1 / 200) ** 0.5},
        "loam": {"params.registration.kernel": 0.1, "params.knn.radius": 1.0},
        "lio_sam": {"params.lidar.max_range": 1000.0, "config.features.order": "azimuth"},
    }
    for recipe, values in known.items():
        for path, value in values.items():
            assert value_at(recipe_settings(recipe), path) == value


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_shipped_file_is_what_the_declarations_give(recipe):
    assert (CONFIGS / f"{recipe}.yaml").read_text() == recipe_file(recipe), "run make settings"
    assert load_settings(CONFIGS / f"{recipe}.yaml").as_dict() == recipe_settings(recipe).as_dict()


def test_the_settings_reference_is_what_the_declarations_give():
    assert (CONFIGS.parents[1] / "docs" / "settings.md").read_text() == reference(), "run make settings"


def test_a_file_changes_values_of_the_recipe_it_names():
    settings = settings_from_yaml("recipe: fast_lio2\nparams: {knn: {radius: 1.5}}", "my.yaml")
    assert settings.values["knn"]["radius"] == 1.5
    assert settings.values["map"]["voxel_size"] == 0.5
    assert settings.given == {"params.knn.radius"}
    # the order of the keys does not matter
    other = settings_from_yaml("params: {knn: {radius: 1.5}}\nrecipe: fast_lio2", "my.yaml")
    assert other.as_dict() == settings.as_dict()


def test_the_command_line_starts_from_the_recipes_values():
    settings = resolve_settings("fast_lio2", ("params.knn.radius=1.5",))
    assert settings.config.registration.max_iterations == 8
    assert settings.values["knn"]["radius"] == 1.5


def test_a_resolved_file_repeats_itself():
    settings = with_overrides(recipe_settings("fast_lio2"), ["params.map.voxel_size=0.4"])
    assert settings_from_yaml(settings.to_yaml(), "config.yaml").as_dict() == settings.as_dict()


def test_the_default_recipe_is_the_default():
    assert recipe_settings("default").as_dict() == Settings().as_dict()


def test_the_recipe_is_not_an_override_because_it_brings_values():
    with pytest.raises(UsageError, match=r"^--set recipe: choose the recipe by --recipe"):
        with_overrides(Settings(), ["recipe=fast_lio2"])
