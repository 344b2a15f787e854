"""Parameters: plain numbers and pytree are two forms of the same values."""

import copy
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.leaf import numbers_of, sections_of, settings_of, traced
from lio_jax.core.leaf import section as declared_section
from lio_jax.imu.params import ImuParams
from lio_jax.recipes import RECIPES
from tests.params import DEFAULTS, Params, default_params, params_from_values

PATHS = [f"{section}.{name}" for section, leaves in DEFAULTS.items() for name in leaves]


def problem(path: str, value: object) -> str:
    """Return why a parameter's value is impossible, or nothing."""
    return settings_of(Params)[path].declared.problem(value)


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_setting_says_what_it_means(recipe):
    for tree in (RECIPES[recipe].config_type, RECIPES[recipe].params_type):
        for path, setting in settings_of(tree).items():
            assert setting.doc.endswith("."), path
            assert not setting.doc.startswith("Of "), path


def test_a_base_class_without_source_or_fields_is_no_obstacle():
    # an abstract class of Python, such as Hashable, has such annotations once somebody has asked for them
    bare = type("Bare", (), {"__annotations__": {}})

    class Numbers(ImuParams, bare):
        pass

    class Tree(eqx.Module):
        imu: Numbers = declared_section(Numbers)

    assert settings_of(Tree)["imu.gyro_noise"].doc.endswith(".")


@pytest.mark.parametrize("recipe", RECIPES)
def test_numbers_and_arrays_are_the_same_values(recipe):
    tree = RECIPES[recipe].params_type
    params = traced(tree)
    for section, leaves in numbers_of(tree).items():
        for name, value in leaves.items():
            np.testing.assert_array_equal(getattr(getattr(params, section), name), value)


@pytest.mark.parametrize("path", PATHS)
def test_each_value_reaches_the_leaf_of_its_name(path):
    section, name = path.split(".")
    values = copy.deepcopy(DEFAULTS)
    length = 2 if settings_of(Params)[path].declared.per_ring else None
    if isinstance(values[section][name], list):
        length = length or len(values[section][name])
    wanted = 0.375 if length is None else [0.375 + i for i in range(length)]
    values[section][name] = wanted
    params = params_from_values(values)
    np.testing.assert_array_equal(getattr(getattr(params, section), name), wanted)
    differs = [
        not np.array_equal(one, other)
        for one, other in zip(jax.tree.leaves(params), jax.tree.leaves(default_params()), strict=True)
    ]
    assert sum(differs) == 1


def test_defaults_name_every_leaf():
    for section in dataclasses.fields(Params):
        kind = sections_of(Params)[section.name]
        assert set(DEFAULTS[section.name]) == {f.name for f in dataclasses.fields(kind)}
    assert set(DEFAULTS) == {section.name for section in dataclasses.fields(Params)}


@pytest.mark.parametrize(("x64", "dtype"), [(True, jnp.float64), (False, jnp.float32)])
def test_dtype_follows_the_x64_flag(x64, dtype):
    with jax.enable_x64(x64):
        assert {leaf.dtype for leaf in jax.tree.leaves(default_params())} == {jnp.dtype(dtype)}


@pytest.mark.parametrize("path", PATHS)
def test_default_is_possible(path):
    section, name = path.split(".")
    assert problem(path, settings_of(Params)[path].declared.default) == ""
    assert np.array_equal(DEFAULTS[section][name], settings_of(Params)[path].declared.default)


@pytest.mark.parametrize(
    "path",
    [
        path
        for path in PATHS
        if not path.startswith(("extrinsics", "gps.lever_arm", "initial.velocity"))
        and not path.endswith(("elevation_offset", "range_offset"))
    ],
)
def test_negative_is_impossible(path):
    assert "must" in problem(path, -0.1)


@pytest.mark.parametrize(
    "path",
    ["lidar.range_sigma", "map.voxel_size", "map.reach", "registration.kernel", "registration.point_spacing"],
)
def test_zero_is_impossible_where_it_divides(path):
    assert problem(path, 0.0) == "must be greater than zero"


@pytest.mark.parametrize(
    "path", ["motion.error_decay", "registration.degeneracy_ratio", "registration.inertial_degeneracy_ratio"]
)
def test_fraction_is_at_most_one(path):
    assert problem(path, 1.0) == ""
    assert problem(path, 1.01) == "must be at most 1"


def test_an_elevation_offset_is_no_number_of_degrees():
    assert problem("lidar.elevation_offset", 0.00358) == ""
    assert problem("lidar.elevation_offset", -0.00358) == ""
    assert problem("lidar.elevation_offset", 0.205) == "must be at most 0.1"
    assert problem("lidar.ring_elevation_offset", [0.001, -0.2]) == "must be at least -0.1"
    assert problem("lidar.ring_elevation_offset", []) == ""


def test_quaternion_has_unit_norm():
    assert problem("extrinsics.rotation", [0.6, 0.0, 0.0, 0.8]) == ""
    assert "norm is 2" in problem("extrinsics.rotation", [0.0, 0.0, 0.0, 2.0])
    assert "unit quaternion" in problem("extrinsics.rotation", [0.0, 0.0, 0.0, 0.0])


def test_extrinsic_pose_is_scipys():
    quaternion = Rotation.from_euler("xyz", [0.3, -0.8, 2.0]).as_quat()
    values = copy.deepcopy(DEFAULTS)
    values["extrinsics"] = {
        "rotation": quaternion.tolist(),
        "translation": [1.0, -2.0, 3.0],
        "time_offset": 0.0,
    }
    T = np.asarray(params_from_values(values).extrinsics.T_imu_lidar().as_matrix())
    np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(quaternion).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(T[:3, 3], [1, -2, 3])
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
