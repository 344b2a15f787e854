"""Parameters are traced: changing one recompiles nothing, a batch of them is a vmap, the state is donated."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.leaf import numbers_of, traced
from lio_jax.core.types import state_dtype
from lio_jax.recipes.default import Default
from lio_jax.recipes.default_params import DefaultParams
from tests.recipes.drive import (
    CONFIG,
    PARAMS,
    Step,
    apart,
    expected_pose,
    initial,
    params_with,
    run,
    scan,
)

PATHS = [f"{section}__{name}" for section, leaves in numbers_of(DefaultParams).items() for name in leaves]

SETS = [
    {},
    {"registration__kernel": 0.4},
    {"lidar__range_sigma": 0.02},
    {"map__voxel_size": 1.0},
    {"registration__point_spacing": 0.5},
    {"map__point_spacing": 0.4, "map__min_points": 4.0},
    {"motion__initial_error": 1.0, "motion__error_decay": 0.3},
    {"lidar__max_range": 15.0, "extrinsics__translation": [0.3, -0.2, 0.1]},
]


def test_every_leaf_has_a_path():
    assert len(PATHS) == len(jax.tree.leaves(traced(DefaultParams)))


@pytest.mark.parametrize("path", PATHS)
def test_parameters_come_as_arrays_of_the_states_precision(path):
    """A Python number among the leaves would be another program."""
    section, name = path.split("__")
    leaf = getattr(getattr(PARAMS, section), name)
    assert leaf.dtype == state_dtype()
    assert not leaf.weak_type


@pytest.mark.long
def test_a_batch_of_parameters_equals_one_run_after_another():
    """Up to float32: batched sums and divisions are rounded otherwise, and a point may change its voxel."""
    scans = [scan(number) for number in range(5)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(params_with(**changes) for changes in SETS))
    step = jax.jit(jax.vmap(Default(CONFIG).step, in_axes=(0, 0, None)))
    states = jax.vmap(Default(CONFIG).init)(batch)
    poses = []
    for item in scans:
        states, outputs = step(batch, states, item)
        poses.append(np.asarray(jax.vmap(lambda T: T.as_matrix())(states.nav.T_world_imu)))
    distinct = set()
    for row, changes in enumerate(SETS):
        alone = run(scans, params_with(**changes))
        for number, one in enumerate(alone):
            np.testing.assert_allclose(poses[number][row], one.T_world_imu, atol=5e-5, err_msg=f"{changes}")
        assert abs(int(outputs.registration.matches[row] - alone[-1].output.registration.matches)) <= 5
        assert abs(int(outputs.added[row].sum()) - int(alone[-1].output.added.sum())) <= 5
        distinct.add(alone[-1].T_world_imu.tobytes())
    assert len(distinct) == len(SETS)


def test_the_state_is_donated():
    keeping, donating = jax.jit(Default(CONFIG).step), jax.jit(Default(CONFIG).step, donate_argnums=1)
    kept, state = initial(), jax.tree.map(jnp.array, initial())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number in range(3):
            kept, _ = keeping(PARAMS, kept, scan(number))
            before = state
            state, output = donating(PARAMS, before, scan(number))
            assert before.map.moments.is_deleted()
            assert not output.points.is_deleted()
    # up to float32: on some processors the two programs round differently
    found, expected = (one.nav.T_world_imu.wxyz_xyz for one in (state, kept))
    np.testing.assert_allclose(found, expected, atol=5e-5)
    assert abs(int(jnp.sum(state.map.moments[:, 0]) - jnp.sum(kept.map.moments[:, 0]))) <= 5


def test_single_precision_states_where_x64_is_off():
    with jax.enable_x64(False):
        params = params_with()
        step = jax.jit(Default(CONFIG).step)
        state = Default(CONFIG).init(params)
        for number in range(6):
            state, output = step(params, state, scan(number))
        assert {str(leaf.dtype) for leaf in jax.tree.leaves((state, output))} <= {
            "float32",
            "int32",
            "uint32",
            "bool",
        }
        assert apart(Step(state, output).T_world_imu, expected_pose(0.6))[0] < 0.06
