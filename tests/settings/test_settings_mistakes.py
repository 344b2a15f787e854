"""Settings that cannot be: each mistake gets one sentence with the file and key at fault."""

import pytest

from lio_jax.core.errors import UsageError
from lio_jax.settings.settings import Settings, load_settings, settings_from_yaml, with_overrides
from tests.settings.test_settings import PATHS, SOURCE, as_file, owner

UNKNOWN = [
    ("params: {registration: {kernal: 1}}", "params.registration.kernal", "params.registration.kernel"),
    ("params: {regstration: {kernel: 1}}", "params.regstration.kernel", "params.registration.kernel"),
    ("config: {map: {capacty: 4}}", "config.map.capacty", "config.map.capacity"),
    ("config: {registration: {kernel: 4}}", "config.registration.kernel", "params.registration.kernel"),
    ("map: {voxel_size: 1}", "map.voxel_size", "params.map.voxel_size"),
    ("voxel_size: 1", "voxel_size", "params.map.voxel_size"),
    ("recipes: default", "recipes", "recipe"),
    ("params: {map: {reach: {m: 5}}}", "params.map.reach.m", "params.map.reach"),
]


@pytest.mark.parametrize(("text", "key", "nearest"), UNKNOWN)
def test_unknown_key_names_file_key_and_nearest(text, key, nearest):
    with pytest.raises(UsageError) as caught:
        settings_from_yaml(text, SOURCE)
    message = str(caught.value)
    assert message.startswith(f"{SOURCE}: ")
    assert f"'{key}'" in message
    assert f"'{nearest}'" in message


@pytest.mark.parametrize("path", PATHS)
def test_a_typing_slip_in_any_path_is_traced_back_to_it(path):
    slip = path[:-2] + path[-1] + path[-2] if path[-1] != path[-2] else path[:-1]
    with pytest.raises(UsageError, match="unknown key") as caught:
        with_overrides(owner(path), [f"{slip}=1"])
    assert f"'{path}'" in str(caught.value)
    assert "--set" in str(caught.value)


def test_nonsense_key_still_gets_an_answer():
    with pytest.raises(UsageError, match="did you mean"):
        settings_from_yaml("zzz: 1", SOURCE)


def test_a_number_as_key_is_unknown():
    with pytest.raises(UsageError, match="unknown key '5'"):
        settings_from_yaml("5: 1", SOURCE)


WRONG_TYPE = [
    ("config.map.capacity", 4096.5, "a whole number"),
    ("config.map.capacity", "many", "a whole number"),
    ("config.map.capacity", True, "a whole number"),
    ("config.map.capacity", None, "a whole number"),
    ("config.data.lidar_topic", 5, "text"),
    ("config.data.lidar_topic", ["/points"], "text"),
    ("config.output.map", "maybe", "true or false"),
    ("config.output.map", 1, "true or false"),
    ("config.data.time_unit", "minutes", "one of auto, s, ms, us, ns"),
    ("config.data.time_unit", 5, "one of auto, s, ms, us, ns"),
    ("config.data.stamp_at", None, "one of auto, start, end"),
    ("config.lidar.buckets", 8192, "list of whole numbers"),
    ("config.lidar.buckets", [], "list of whole numbers"),
    ("config.lidar.buckets", [1024.5], "a whole number"),
    ("config.output.keyframe_distance", "far", "a number"),
    ("config.output.keyframe_distance", True, "a number"),
    ("params.registration.kernel", "wide", "a number"),
    ("params.registration.kernel", True, "a number"),
    ("params.registration.kernel", None, "a number"),
    ("params.registration.kernel", [0.2], "a number"),
    ("params.registration.kernel", float("nan"), "a number"),
    ("params.registration.kernel", float("inf"), "a number"),
    ("params.extrinsics.translation", 1.0, "a list of 3 numbers"),
    ("params.extrinsics.translation", [1.0, 2.0], "a list of 3 numbers"),
    ("params.extrinsics.translation", [1.0, 2.0, "x"], "a list of 3 numbers"),
    ("params.extrinsics.rotation", [0, 0, 1], "a list of 4 numbers"),
    ("params.lidar.ring_range_offset", 0.1, "a list with one number per ring"),
    ("params.lidar.ring_range_offset", [0.1, "x"], "a list with one number per ring"),
    ("params.lidar.ring_elevation_offset", [0.001, 0.2], "at most 0.1"),
    ("params.lidar.elevation_offset", 0.205, "at most 0.1"),
]


@pytest.mark.parametrize(("path", "value", "wanted"), WRONG_TYPE)
def test_wrong_type_names_file_key_and_what_is_wanted(path, value, wanted):
    with pytest.raises(UsageError) as caught:
        settings_from_yaml(as_file(path, value), SOURCE)
    assert str(caught.value).startswith(f"{SOURCE}: {path} = ")
    assert wanted in str(caught.value)


IMPOSSIBLE = [
    ("config.map.capacity", 1000, "power of two"),
    ("config.map.capacity", 0, "power of two"),
    ("config.map.capacity", -8, "power of two"),
    ("config.lidar.buckets", [2048, 1024], "ascending"),
    ("config.lidar.buckets", [1024, 1024], "ascending"),
    ("config.lidar.buckets", [0, 1024], "positive"),
    ("config.lidar.registration_points", 0, "greater than zero"),
    ("config.registration.max_iterations", 0, "greater than zero"),
    ("config.data.beams", -1, "not be negative"),
    ("config.data.scan_period", 0.0, "greater than zero"),
    ("params.registration.kernel", 0, "greater than zero"),
    ("params.registration.kernel", -0.2, "greater than zero"),
    ("params.registration.kernel", 1e10, "must not exceed 1e+09 in size"),
    ("params.initial.velocity", [0.0, -1e200, 0.0], "must not exceed 1e+09 in size"),
    ("config.registration.max_iterations", 10**10, "must not exceed 1e+09 in size"),
    ("params.map.voxel_size", 0.0, "greater than zero"),
    ("params.lidar.min_range", -1.0, "not be negative"),
    ("params.motion.error_decay", 1.5, "at most 1"),
    ("params.extrinsics.rotation", [0, 0, 0, 2], "unit quaternion"),
]


@pytest.mark.parametrize(("path", "value", "reason"), IMPOSSIBLE)
def test_impossible_value_names_file_key_and_reason(path, value, reason):
    with pytest.raises(UsageError) as caught:
        settings_from_yaml(as_file(path, value), SOURCE)
    assert str(caught.value).startswith(f"{SOURCE}: {path} = ")
    assert reason in str(caught.value)


@pytest.mark.parametrize(("smallest", "largest"), [(5.0, 5.0), (10.0, 5.0)])
def test_ranges_must_be_in_order(smallest, largest):
    text = f"params: {{lidar: {{min_range: {smallest}, max_range: {largest}}}}}"
    with pytest.raises(
        UsageError, match=r"my\.yaml: params\.lidar\.min_range .* below params\.lidar\.max_range"
    ):
        settings_from_yaml(text, SOURCE)
    with pytest.raises(UsageError, match=r"--set: params\.lidar\.min_range"):
        with_overrides(
            Settings(), [f"params.lidar.min_range={smallest}", f"params.lidar.max_range={largest}"]
        )


def test_a_ring_must_have_more_room_than_a_point_has_neighbours():
    with pytest.raises(
        UsageError, match=r"^my\.yaml: config\.features\.columns \(16\) must be more than twice"
    ):
        settings_from_yaml("recipe: loam\nconfig: {features: {columns: 16, neighbours: 8}}", SOURCE)


@pytest.mark.parametrize("text", ["params: [", "a: b: c", "\tconfig: {}", "params: {map: {reach: 5}"])
def test_not_yaml_names_the_file(text):
    with pytest.raises(UsageError, match=r"^my\.yaml: not valid YAML") as caught:
        settings_from_yaml(text, SOURCE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "just words", "5"])
def test_yaml_that_is_no_mapping(text):
    with pytest.raises(UsageError, match=r"^my\.yaml: expected keys 'recipe', 'config' and 'params'"):
        settings_from_yaml(text, SOURCE)


@pytest.mark.parametrize(
    ("text", "key"),
    [("config: 5", "config"), ("params: {map: 5}", "params.map"), ("config: {data: []}", "config.data")],
)
def test_a_value_where_keys_belong(text, key):
    with pytest.raises(UsageError, match="must hold keys, for example") as caught:
        settings_from_yaml(text, SOURCE)
    assert f"{SOURCE}: {key} = " in str(caught.value)


def test_override_without_equals_shows_how():
    with pytest.raises(UsageError, match=r"--set params\.map\.reach: write it as path=value"):
        with_overrides(Settings(), ["params.map.reach"])


def test_override_that_is_not_yaml():
    with pytest.raises(UsageError, match=r"--set params\.map\.reach: the value '\[' is not valid YAML"):
        with_overrides(Settings(), ["params.map.reach=["])


def test_file_that_is_not_there_is_named(tmp_path):
    path = tmp_path / "absent.yaml"
    with pytest.raises(UsageError, match="the settings file cannot be read") as caught:
        load_settings(path)
    assert str(path) in str(caught.value)


def test_file_that_is_not_text_is_named(tmp_path):
    path = tmp_path / "binary.yaml"
    path.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(UsageError, match=r"binary\.yaml: is not a text file"):
        load_settings(path)
