"""Parameters: plain numbers and pytree are two forms of the same values."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.param_values import DEFAULTS, invalid_value
from lio_jax.core.params import Params, default_params, params_from_values, values_from_params

PATHS = [f"{section}.{name}" for section, leaves in DEFAULTS.items() for name in leaves]


def test_values_round_trip():
    assert values_from_params(params_from_values(DEFAULTS)) == DEFAULTS


def test_params_round_trip():
    params = jax.tree.map(lambda leaf: leaf * 1.234567890123, default_params())
    again = params_from_values(values_from_params(params))
    assert jax.tree.structure(again) == jax.tree.structure(params)
    for before, after in zip(jax.tree.leaves(params), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("path", PATHS)
def test_each_value_reaches_the_leaf_of_its_name(path):
    section, name = path.split(".")
    values = copy.deepcopy(DEFAULTS)
    wanted = (
        [0.375 + i for i in range(len(values[section][name]))]
        if isinstance(values[section][name], list)
        else 0.375
    )
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
        assert set(DEFAULTS[section.name]) == {f.name for f in dataclasses.fields(section.type)}
    assert set(DEFAULTS) == {section.name for section in dataclasses.fields(Params)}


@pytest.mark.parametrize(("x64", "dtype"), [(True, jnp.float64), (False, jnp.float32)])
def test_dtype_follows_the_x64_flag(x64, dtype):
    with jax.enable_x64(x64):
        assert {leaf.dtype for leaf in jax.tree.leaves(default_params())} == {jnp.dtype(dtype)}


@pytest.mark.parametrize("path", PATHS)
def test_default_is_possible(path):
    section, name = path.split(".")
    assert invalid_value(path, DEFAULTS[section][name]) == ""


@pytest.mark.parametrize(
    "path", [path for path in PATHS if not path.startswith(("extrinsics", "gps.lever_arm"))]
)
def test_negative_is_impossible(path):
    assert "must" in invalid_value(path, -0.1)


@pytest.mark.parametrize(
    "path",
    ["lidar.range_sigma", "map.voxel_size", "map.reach", "registration.kernel", "registration.point_spacing"],
)
def test_zero_is_impossible_where_it_divides(path):
    assert invalid_value(path, 0.0) == "must be greater than zero"


@pytest.mark.parametrize(
    "path", ["motion.error_decay", "registration.degeneracy_ratio", "registration.inertial_degeneracy_ratio"]
)
def test_fraction_is_at_most_one(path):
    assert invalid_value(path, 1.0) == ""
    assert invalid_value(path, 1.01) == "must be at most 1"


def test_quaternion_has_unit_norm():
    assert invalid_value("extrinsics.rotation", [0.6, 0.0, 0.0, 0.8]) == ""
    assert "norm is 2" in invalid_value("extrinsics.rotation", [0.0, 0.0, 0.0, 2.0])
    assert "unit quaternion" in invalid_value("extrinsics.rotation", [0.0, 0.0, 0.0, 0.0])


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
