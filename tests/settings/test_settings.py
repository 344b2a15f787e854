"""Settings files and overrides: strict, and exact both ways."""

import pickle
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import UsageError
from lio_jax.recipes import RECIPES
from lio_jax.settings.settings import (
    Settings,
    declared_settings,
    load_settings,
    recipe_settings,
    settings_from_yaml,
    with_extrinsics,
    with_overrides,
)

SOURCE = "my.yaml"


OWNERS = {path: recipe for recipe in reversed(RECIPES) for path in declared_settings(recipe)}
"""A recipe that reads a path."""
DECLARED = {path: declared_settings(recipe)[path] for path, recipe in OWNERS.items()}
PATHS = list(OWNERS)
PARAMS = [path for path in PATHS if path.startswith("params.")]
DEFAULT_PATHS = list(declared_settings("default"))


def owner(path: str) -> Settings:
    """Return settings of a recipe that reads a path."""
    return recipe_settings(OWNERS[path])


def value_at(settings: Settings, path: str) -> Any:
    """Return what the settings hold at a path."""
    kind, section, name = path.split(".")
    if kind == "params":
        return settings.values[section][name]
    tree = settings.config if hasattr(settings.config, section) else settings.run
    return getattr(getattr(tree, section), name)


def values_for(path: str) -> st.SearchStrategy:
    """Return possible values of a path, as YAML would give them."""
    if path == "params.extrinsics.rotation":
        return st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(rng=seed).as_quat().tolist())
    if isinstance(DECLARED[path].declared.default, tuple) and len(DECLARED[path].declared.default) == 3:
        return st.lists(st.floats(-100, 100), min_size=3, max_size=3)
    if path in PARAMS and DECLARED[path].declared.per_ring:
        return st.lists(st.floats(-0.1, 0.1), max_size=5)
    if path == "params.lidar.elevation_offset":
        return st.floats(-0.1, 0.1)
    if path in PARAMS:
        return st.floats(1e-6, 1.0) if path != "params.lidar.max_range" else st.floats(3.0, 500.0)
    kind = DECLARED[path].type
    if path == "config.map.capacity":
        return st.integers(1, 24).map(lambda bits: 2**bits)
    if path == "config.knn.neighbours":
        return st.integers(3, 100)
    if path == "config.lio_sam.window":
        return st.integers(2, 1000)
    if path == "config.features.neighbours":
        return st.integers(1, 100)
    if path == "config.features.columns":
        return st.integers(201, 10**5)
    if path.endswith(".buckets"):
        return st.lists(st.integers(1, 10**6), min_size=1, max_size=6, unique=True).map(sorted)
    if get_origin(kind) is Literal:
        return st.sampled_from(get_args(kind))
    return {
        bool: st.booleans(),
        int: st.integers(1, 10**6),
        float: st.floats(1e-6, 1e3),
        str: st.text(st.characters(blacklist_categories=("Cs",)), max_size=20),
    }[kind]


def expected(path: str, value: Any) -> Any:
    return tuple(value) if path.endswith(".buckets") else value


def as_file(path: str, value: Any) -> str:
    kind, section, name = path.split(".")
    return yaml.safe_dump({"recipe": OWNERS[path], kind: {section: {name: value}}})


assignments = st.sampled_from(DEFAULT_PATHS).flatmap(lambda path: st.tuples(st.just(path), values_for(path)))


@hypothesis_settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(assignments, max_size=8))
def test_resolved_settings_round_trip_through_yaml(pairs):
    settings = Settings()
    for path, value in pairs:
        settings = settings.with_value(path, value, SOURCE)
    again = settings_from_yaml(settings.to_yaml(), SOURCE)
    assert again.as_dict() == settings.as_dict()
    assert again.config == settings.config
    assert hash(again.config) == hash(settings.config)
    assert again.values == settings.values


@hypothesis_settings(max_examples=150, deadline=None, derandomize=True)
@given(assignments)
def test_an_override_and_a_file_set_the_same_value_and_nothing_else(pair):
    path, value = pair
    by_override = with_overrides(Settings(), [f"{path}={yaml.safe_dump(value, default_flow_style=True)}"])
    by_file = settings_from_yaml(as_file(path, value), SOURCE)
    assert value_at(by_override, path) == expected(path, value)
    assert by_override == by_file
    assert by_file.given == {path}
    untouched = [other for other in DEFAULT_PATHS if other != path]
    assert all(value_at(by_file, other) == value_at(Settings(), other) for other in untouched)


@pytest.mark.parametrize("path", PATHS)
def test_every_path_takes_its_default_as_an_override(path):
    default = value_at(owner(path), path)
    plain = list(default) if isinstance(default, tuple) else default
    text = yaml.safe_dump(plain, default_flow_style=True).removesuffix("...\n").strip()
    assert value_at(with_overrides(owner(path), [f"{path}={text}"]), path) == default


def test_documented_override_examples():
    settings = with_overrides(
        Settings(),
        [
            "params.extrinsics.translation=[0,0,0.28]",
            "params.registration.kernel=0.003",
            "config.map.capacity=65536",
            "config.lidar.buckets=[1024,2048]",
            "config.output.map=false",
        ],
    )
    assert settings.values["extrinsics"]["translation"] == [0, 0, 0.28]
    assert settings.values["registration"]["kernel"] == 0.003
    assert settings.config.map.capacity == 65536
    assert settings.config.lidar.buckets == (1024, 2048)
    assert settings.run.output.map is False


def test_later_override_wins():
    settings = with_overrides(Settings(), ["config.map.capacity=4", "config.map.capacity=8"])
    assert settings.config.map.capacity == 8


def test_file_holds_where_it_speaks_and_the_base_elsewhere():
    base = with_overrides(Settings(), ["params.map.reach=77", "params.map.voxel_size=0.9"])
    settings = settings_from_yaml("params: {map: {reach: 55}}", SOURCE, base)
    assert settings.values["map"]["reach"] == 55
    assert settings.values["map"]["voxel_size"] == 0.9


def test_settings_are_values():
    base = Settings()
    changed = with_overrides(base, ["params.extrinsics.translation=[1,2,3]"])
    changed.values["extrinsics"]["translation"][0] = 9.0
    assert base.values == Settings().values


@pytest.mark.parametrize("text", ["", "# nothing\n", "params:\n", "params: {map: }\n", "config: {}\n"])
def test_an_empty_file_or_section_leaves_the_defaults(text):
    assert settings_from_yaml(text, SOURCE).as_dict() == Settings().as_dict()


def test_params_hold_the_values():
    params = with_overrides(Settings(), ["params.registration.kernel=0.31"]).params()
    assert float(params.registration.kernel) == 0.31


def test_settings_of_a_recipe_hold_nothing_that_another_reads():
    with pytest.raises(
        UsageError, match=r"recipe default does not read 'params.knn.radius' \(fast_lio2, lio_sam"
    ):
        with_overrides(Settings(), ["params.knn.radius=1"])
    assert "knn" not in Settings().as_dict()["params"]


@pytest.mark.parametrize("recipe", RECIPES)
def test_settings_can_be_sent_to_another_process(recipe):
    settings = with_overrides(
        recipe_settings(recipe), ["params.map.voxel_size=0.77", "config.output.map=false"]
    )
    assert pickle.loads(pickle.dumps(settings)) == settings


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("config.data.beams", 0),
        ("config.data.vertical_correction_deg", 0.0),
        ("config.data.vertical_correction_deg", -0.2),
        ("params.lidar.min_range", 0.0),
        ("params.extrinsics.translation", [-1.0, 0.0, 0.0]),
    ],
)
def test_zero_and_negative_where_they_mean_something(path, value):
    assert value_at(settings_from_yaml(as_file(path, value), SOURCE), path) == value


def test_ranges_that_fit_only_together_may_be_given_in_any_order():
    settings = with_overrides(Settings(), ["params.lidar.min_range=200", "params.lidar.max_range=300"])
    assert settings.values["lidar"]["min_range"] == 200


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "1.e-3", "'1e-3'", "0.001"])
def test_exponents_that_yaml_reads_as_text_are_numbers(text):
    assert with_overrides(Settings(), [f"params.registration.kernel={text}"]).values["registration"][
        "kernel"
    ] == pytest.approx(1e-3, rel=1e-15)
    read = settings_from_yaml(f"config: {{output: {{keyframe_distance: {text}}}}}", SOURCE)
    assert read.run.output.keyframe_distance == pytest.approx(1e-3, rel=1e-15)


def test_exponents_inside_a_list():
    settings = with_overrides(Settings(), ["params.extrinsics.translation=[1e-3, -2e-1, 3]"])
    assert settings.values["extrinsics"]["translation"] == [1e-3, -0.2, 3.0]


@pytest.mark.parametrize(
    ("text", "value"), [("yes", "yes"), ("no", "no"), ("auto", "auto"), ("'yes'", "yes")]
)
def test_yes_and_no_are_words_where_words_are_wanted(text, value):
    assert with_overrides(Settings(), [f"config.data.compensated={text}"]).run.data.compensated == value


@pytest.mark.parametrize(("text", "value"), [("yes", True), ("no", False), ("true", True), ("off", False)])
def test_yes_and_no_are_booleans_where_booleans_are_wanted(text, value):
    assert with_overrides(Settings(), [f"config.output.map={text}"]).run.output.map is value


def test_override_value_may_hold_an_equals_sign():
    settings = with_overrides(Settings(), ["config.data.lidar_topic=/a=b"])
    assert settings.run.data.lidar_topic == "/a=b"


def test_file_is_read_from_disk_and_named_in_messages(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("recipe: default\nparams: {map: {reach: 33}}\n")
    assert load_settings(path).values["map"]["reach"] == 33
    path.write_text("params: {map: {reach: -33}}\n")
    with pytest.raises(UsageError) as caught:
        load_settings(path)
    assert str(caught.value).startswith(f"{path}: params.map.reach = -33 ")


def test_extrinsics_from_a_matrix():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zyx", [2.0, 0.4, -0.3]).as_matrix()
    T[:3, 3] = [0.1, -0.2, 0.3]
    settings = with_extrinsics(Settings(), T, SOURCE)
    np.testing.assert_allclose(settings.params().extrinsics.T_imu_lidar().as_matrix(), T, atol=1e-12)
    assert {path.rsplit(".", 1)[0] for path in settings.given} == {"params.extrinsics"}


def test_the_shipped_default_file_is_the_default():
    path = Path(__file__).resolve().parents[2] / "configs" / "recipes" / "default.yaml"
    assert load_settings(path).as_dict() == Settings().as_dict()
