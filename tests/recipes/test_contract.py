"""What holds for every recipe, those to come included: the form of its state, its precision, its programs."""

import collections
import re
import warnings
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.leaf import numbers_of
from lio_jax.core.types import LOST
from lio_jax.core.xla import PerShape
from lio_jax.recipes import RECIPES, recipe_named
from lio_jax.recipes.recipe import Output, Recipe, State
from lio_jax.settings.settings import (
    Settings,
    declared_settings,
    recipe_of,
    recipe_settings,
    with_extrinsics,
    with_overrides,
)
from tests.recipes.street import MOVING, SCANS, Driven, arrays, ate, recording

SMALL = [
    "config.lidar.buckets=[8192]",
    "config.lidar.registration_points=2048",
    "config.imu.buckets=[64]",
    "config.map.capacity=16384",
    "config.features.rings=16",
    "config.features.columns=576",
    "config.features.surface_points=6144",
    "config.fast_lio2.point_filter_num=1",
    "config.loam.corner_points=2048",
    "config.loam.surface_points=2048",
    "config.lio_sam.window=4",
    "config.lio_sam.keyframes=16",
    "config.lio_sam.corner_points=1024",
    "config.lio_sam.surface_points=2048",
    "params.lidar.min_range=1.0",
]
EMPTY = 18
WAYS = {"required": (True,), "used": (True, False), "unused": (False,)}
CASES = [(name, inertial) for name, recipe in RECIPES.items() for inertial in WAYS[recipe.needs.imu]]


@cache
def settings(name: str) -> Settings:
    T_imu_lidar = recording()[0].info.T_imu_lidar
    read = declared_settings(name)
    small = [one for one in SMALL if one.partition("=")[0] in read]
    return with_overrides(with_extrinsics(recipe_settings(name), T_imu_lidar, "test"), small)


@cache
def programs(name: str) -> tuple[Recipe, PerShape, PerShape]:
    """Return a recipe with its init and its step, compiled as the runner's are but for the donation."""
    recipe = recipe_of(settings(name))
    return recipe, PerShape(jax.jit(recipe.init)), PerShape(jax.jit(recipe.step))


class Case:
    """A recipe with inertial samples or without."""

    def __init__(self, name: str, inertial: bool) -> None:
        self.name, self.inertial = name, inertial
        self.recipe, self.init, self.step = programs(name)
        self.params = settings(name).params()
        self.inputs, self.before = arrays(settings(name).config, inertial)
        self.drive = self.run()

    def first(self, params=None) -> State:
        return self.init(self.params if params is None else params, self.before)

    def run(self, change=lambda number, scan: scan, count: int = SCANS) -> Driven:
        state, states, outputs = self.first(), [], []
        for number in range(count):
            scan, samples = self.inputs[number]
            state, output = self.step(self.params, state, change(number, scan), samples)
            states.append(state)
            outputs.append(output)
        return Driven(states, outputs)


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}-{'imu' if case[1] else 'lidar'}")
def case(request: pytest.FixtureRequest) -> Case:
    return Case(*request.param)


def assert_equal(one, other) -> None:
    """Every leaf is the same to the last bit."""
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(left, right)


def abstract(tree):
    return [jax.typeof(leaf) for leaf in jax.tree.leaves(tree)]


def test_it_is_found_by_its_name(case):
    assert recipe_named(case.name) is RECIPES[case.name] is type(case.recipe)
    assert case.recipe.config == settings(case.name).config
    assert isinstance(case.drive.states[0], State)
    assert isinstance(case.drive.outputs[0], Output)


def test_the_state_keeps_its_form(case):
    def form(state):
        return jax.tree.structure(state), abstract(state)

    first = form(case.first())
    assert first == form(case.drive.states[0]) == form(case.drive.states[-1])
    assert not any(kind.weak_type for kind in first[1])


def test_repeats_bit_for_bit(case):
    again = case.run()
    assert_equal(again.states, case.drive.states)
    assert_equal(again.outputs, case.drive.outputs)


def test_changing_any_parameter_recompiles_nothing(case):
    """A program is chosen by the arguments' tree, shapes and types, so all may change at once."""
    before = len(case.init), len(case.step)
    for section, leaves in numbers_of(type(case.params)).items():
        for name in leaves:
            leaf = getattr(getattr(case.params, section), name)
            changed = eqx.tree_at(
                lambda p, s=section, n=name: getattr(getattr(p, s), n), case.params, leaf * 0.9
            )
            assert jax.tree.structure(changed) == jax.tree.structure(case.params)
            assert abstract(changed) == abstract(case.params), f"{section}.{name}"
    changed = jax.tree.map(lambda leaf: leaf * 0.9, case.params)
    state = case.first(changed)
    case.step(changed, case.drive.states[MOVING - 1], *case.inputs[MOVING])
    case.step(changed, state, *case.inputs[0])
    assert (len(case.init), len(case.step)) == before
    kinds = abstract(case.params)
    assert {str(kind.dtype) for kind in kinds} == {"float64"}
    assert not any(kind.weak_type for kind in kinds)


def test_the_state_is_donated(case):
    """Each of the map's arrays is changed in place."""
    step = jax.jit(case.recipe.step, donate_argnums=1)
    state = case.first()
    with warnings.catch_warnings():
        # of buffers that no output can take over
        warnings.simplefilter("error")
        text = step.lower(case.params, state, *case.inputs[1]).as_text()
    kinds = {"float32": "f32", "float64": "f64", "int32": "i32", "uint32": "ui32", "bool": "i1"}
    tables = collections.Counter(
        "x".join([*map(str, leaf.shape), kinds[str(leaf.dtype)]]) for leaf in jax.tree.leaves(state.map)
    )
    for table, count in tables.items():
        aliased = re.findall(rf"tensor<{table}> {{[^}}]*tf.aliasing_output", text)
        assert len(aliased) >= count, table


def test_precision_is_single_for_points_and_double_for_states(case):
    state, output = case.drive.states[-1], case.drive.outputs[-1]
    # lio_sam's map has keyframes, and these have poses
    of_points = [leaf for leaf in jax.tree.leaves(state.map) if case.name != "lio_sam" or leaf.size > 1000]
    kinds = {str(leaf.dtype) for leaf in of_points}
    assert kinds <= {"float32", "int32", "uint32"}
    assert output.points.dtype == jnp.float32
    # navigation, twist, covariance: all that is no part of the map
    beside = jax.tree.leaves(eqx.tree_at(lambda s: s.map, state, None, is_leaf=lambda leaf: leaf is None))
    assert {str(leaf.dtype) for leaf in beside} <= {"float64", "int32", "uint32", "bool"}
    assert {str(leaf.dtype) for leaf in jax.tree.leaves(state.nav)} == {"float64"}
    assert output.registration.information.dtype == output.origin.dtype == jnp.float64


def test_an_empty_scan_is_predicted_over(case):
    def emptied(number, scan):
        return eqx.tree_at(lambda s: s.mask, scan, jnp.zeros_like(scan.mask)) if number == EMPTY else scan

    found = case.run(emptied)
    assert [bool(output.lost) for output in found.outputs[2:]] == [n == EMPTY for n in range(2, SCANS)]
    lost = found.outputs[EMPTY]
    assert lost.registration.status == LOST
    assert not lost.added.any()
    assert_equal(found.states[EMPTY].map, found.states[EMPTY - 1].map)
    assert_equal(found.states[: EMPTY - 1], case.drive.states[: EMPTY - 1])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found.states[EMPTY].nav, lost.nis)))
    for leaf, plain in zip(
        jax.tree.leaves(found.states[EMPTY]), jax.tree.leaves(case.drive.states[EMPTY]), strict=True
    ):
        if np.isfinite(plain).all():
            assert np.isfinite(leaf).all()
    off = np.abs(found.poses[EMPTY, :3, 3] - case.drive.poses[EMPTY, :3, 3]).max()
    assert off < (0.02 if case.inertial else 0.06)
    assert ate(found.poses) < ate(case.drive.poses) + 0.02


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_ignored(case, value):
    """Although the mask calls them real."""

    def spoilt(number, scan):
        rows = jnp.arange(len(scan.mask)) % 7 == 3
        return eqx.tree_at(lambda s: s.points, scan, jnp.where(rows[:, None], value, scan.points))

    def without(number, scan):
        rows = jnp.arange(len(scan.mask)) % 7 == 3
        return eqx.tree_at(lambda s: s.mask, scan, scan.mask & ~rows)

    one, other = (case.run(change, count=6) for change in (spoilt, without))
    assert_equal(one.states[-1], other.states[-1])


def test_a_restart_keeps_the_velocity_and_begins_anew(case):
    """Every other leaf is that of a first state, the map's among them."""
    first, found = case.first(), case.drive.states[-1]
    restarted = jax.tree_util.tree_leaves_with_path(first.with_velocity_of(found))
    changed = {}
    for (path, leaf), was in zip(restarted, jax.tree.leaves(first), strict=True):
        name = jax.tree_util.keystr(path)
        if name.endswith((".velocity", ".twist", ".rate")):
            changed[name] = np.asarray(leaf)
        else:
            np.testing.assert_array_equal(leaf, was, err_msg=name)
    later = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(found)}
    assert any(np.any(leaf) for leaf in changed.values())
    for name in {".nav.velocity", ".twist", ".rate"} & set(changed):
        if name != ".nav.velocity" or ".twist" not in changed:
            np.testing.assert_array_equal(changed[name], later[name])
    assert int(first.scans) == 0
    np.testing.assert_allclose(first.nav.T_world_imu.translation(), 0)


def test_a_batch_of_parameters_is_a_vmap(case):
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, 0.9 * leaf]), case.params)
    init = jax.eval_shape(jax.vmap(case.recipe.init, in_axes=(0, None)), batch, case.before)
    step = jax.vmap(case.recipe.step, in_axes=(0, 0, None, None))
    state, output = jax.eval_shape(step, batch, init, *case.inputs[0])

    def batched(tree):
        return [(2, *leaf.shape) for leaf in jax.tree.leaves(tree)]

    assert [leaf.shape for leaf in jax.tree.leaves(init)] == batched(case.drive.states[0])
    assert [leaf.shape for leaf in jax.tree.leaves(state)] == batched(case.drive.states[0])
    assert [leaf.shape for leaf in jax.tree.leaves(output)] == batched(case.drive.outputs[0])
