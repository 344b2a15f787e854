"""The recipe fast_lio2 on simulated recordings whose truth is known, with inertial samples and without."""

from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.error_state import EXTRINSIC_ROTATION, GYRO_BIAS, POSITION
from lio_jax.core.types import LOST
from lio_jax.recipes.fast_lio2 import FastLio2
from lio_jax.run.scan_inputs import ImuFeed, padded
from lio_jax.settings.settings import Settings, recipe_settings, with_extrinsics, with_overrides
from tests.params import Params
from tests.recipes.street import MOVING, SCANS, ate, recording, truth

SMALL = [
    "config.lidar.buckets=[8192]",
    "config.lidar.registration_points=2048",
    "config.imu.buckets=[64]",
    "config.map.capacity=16384",
    "config.fast_lio2.point_filter_num=1",
    "params.lidar.min_range=1.0",
]


def settings_with(*sets: str) -> Settings:
    T_imu_lidar = recording()[0].info.T_imu_lidar
    return with_overrides(with_extrinsics(recipe_settings("fast_lio2"), T_imu_lidar, "test"), [*SMALL, *sets])


CONFIG = with_overrides(recipe_settings("fast_lio2"), SMALL).config
STEP = jax.jit(FastLio2(CONFIG).step)
"""Two programs for all tests: with inertial samples and without."""
INIT = jax.jit(FastLio2(CONFIG).init)


@cache
def arrays(inertial: bool):
    """Return each scan's padded arrays and its samples, and the samples before the first."""
    _, scans, imu = recording()
    feed, last, inputs = ImuFeed(imu, CONFIG.imu.buckets, 0.0, 0.0), None, []
    for scan in scans:
        samples = feed.batch(scan, last) if inertial else None
        inputs.append(jax.tree.map(jnp.asarray, (padded(scan, last, CONFIG.lidar), samples)))
        last = scan.end_ns
    return inputs, jax.tree.map(jnp.asarray, feed.before(scans[0])) if inertial else None


def run(params: Params, inertial: bool = True, change=lambda number, inputs: inputs, count: int = SCANS):
    """Return states and outputs of each scan, and T_world_imu."""
    inputs, before = arrays(inertial)
    state, states, outputs = INIT(params, before), [], []
    for number in range(count):
        scan, samples = change(number, inputs[number])
        state, output = STEP(params, state, scan, samples)
        states.append(state)
        outputs.append(output)
    poses = np.stack([np.asarray(state.nav.T_world_imu.as_matrix()) for state in states])
    return states, outputs, poses


@pytest.fixture(scope="module")
def drive():
    return run(settings_with().params())


@pytest.fixture(scope="module")
def without():
    return run(settings_with().params(), inertial=False)


def test_a_drive_is_tracked(drive):
    states, outputs, poses = drive
    distance = np.linalg.norm(truth()[-1, :3, 3] - truth()[0, :3, 3])
    assert distance > 1
    assert ate(poses) < 0.03
    assert not any(output.lost for output in outputs)
    assert all(output.registration.matches > 200 for output in outputs[1:])
    speed = np.linalg.norm(truth()[-1, :3, 3] - truth()[-2, :3, 3]) / 0.1
    assert np.linalg.norm(states[-1].nav.velocity) == pytest.approx(speed, abs=0.15)


def test_constant_velocity_takes_the_place_of_missing_samples(without):
    states, outputs, poses = without
    assert ate(poses) < 0.06
    assert not any(output.lost for output in outputs[1:])
    # nothing tells these from the motion
    nav = states[-1].nav
    np.testing.assert_array_equal(nav.gyro_bias, 0)
    np.testing.assert_array_equal(nav.accel_bias, 0)
    np.testing.assert_allclose(nav.gravity, [0, 0, -9.80665])
    np.testing.assert_array_equal(nav.T_imu_lidar.wxyz_xyz, states[0].nav.T_imu_lidar.wxyz_xyz)


def test_the_pose_without_samples_is_of_the_scans_end(without):
    """The filter's own instant is the scan's middle."""
    states, _, _ = without
    state = states[-1]
    assert float(state.to_end) == pytest.approx(0.05, abs=1e-3)
    moved = np.asarray((state.uncertain.nav.T_world_imu.inverse() @ state.nav.T_world_imu).translation())
    half_a_scan = np.linalg.norm(truth()[-1, :3, 3] - truth()[-2, :3, 3]) / 2
    assert np.linalg.norm(moved) == pytest.approx(half_a_scan, rel=0.2)


def test_biases_gravity_and_extrinsic_are_estimated_with_a_covariance(drive):
    states, outputs, _ = drive
    first, last = (np.asarray(output.covariance) for output in (outputs[0], outputs[-1]))
    assert np.linalg.eigvalsh(last).min() > -1e-12
    for part in (GYRO_BIAS, EXTRINSIC_ROTATION):
        assert (np.diag(last)[part] < np.diag(first)[part]).all()
        assert (np.diag(last)[part] > 0).all()
    assert (np.diag(last)[POSITION] < 1e-3).all()
    assert float(jnp.linalg.norm(states[-1].nav.gravity)) == pytest.approx(9.80665)
    started = np.asarray(states[0].nav.T_imu_lidar.wxyz_xyz)
    assert 0 < np.abs(np.asarray(states[-1].nav.T_imu_lidar.wxyz_xyz) - started).max() < 0.01
    assert all(float(output.nis) > 0 for output in outputs[1:])


def test_an_extrinsic_without_sigma_stays_to_the_last_bit():
    params = settings_with(
        "params.initial.extrinsic_rotation_sigma=0", "params.initial.extrinsic_translation_sigma=0"
    ).params()
    states, _, _ = run(params, count=MOVING)
    np.testing.assert_array_equal(states[-1].nav.T_imu_lidar.wxyz_xyz, states[0].nav.T_imu_lidar.wxyz_xyz)


def empty(inputs):
    scan, samples = inputs
    return eqx.tree_at(lambda s: s.mask, scan, jnp.zeros_like(scan.mask)), samples


@pytest.mark.parametrize("inertial", [True, False])
def test_an_empty_scan_is_predicted_over(inertial, drive, without):
    states, outputs, poses = run(
        settings_with().params(), inertial, lambda n, inputs: empty(inputs) if n == 18 else inputs
    )
    assert outputs[18].lost
    assert outputs[18].registration.status == LOST
    for one, other in zip(jax.tree.leaves(states[17].map), jax.tree.leaves(states[18].map), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not outputs[19].lost
    assert ate(poses) < ate((drive if inertial else without)[2]) + 0.02
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((states[18].uncertain, outputs[18].nis)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_ignored(value):
    def spoil(number, inputs, bad):
        scan, samples = inputs
        rows = jnp.arange(len(scan.mask)) % 7 == 3
        if bad:
            return eqx.tree_at(
                lambda s: s.points, scan, jnp.where(rows[:, None], value, scan.points)
            ), samples
        return eqx.tree_at(lambda s: s.mask, scan, scan.mask & ~rows), samples

    params = settings_with().params()
    one, other = (run(params, change=partial(spoil, bad=bad), count=6) for bad in (True, False))
    for left, right in zip(jax.tree.leaves(one[0][-1]), jax.tree.leaves(other[0][-1]), strict=True):
        np.testing.assert_array_equal(left, right)


def test_one_map_point_per_voxel_and_the_map_is_of_the_street(drive):
    states, outputs, _ = drive
    assert sum(int(output.map_dropped) for output in outputs) < 100
    held = int(np.isfinite(np.asarray(states[-1].map.off_centre)).sum())
    added = sum(int(output.added.sum()) for output in outputs)
    assert 500 < held <= added


def test_the_first_map_is_empty():
    state = INIT(settings_with().params(), arrays(True)[1])
    assert not np.isfinite(np.asarray(state.map.off_centre)).any()


@pytest.mark.parametrize(
    "change",
    [
        "params.knn.radius=0.6",
        "params.knn.plane_tolerance=0.02",
        "params.knn.min_score=0.99",
        "params.knn.distance_weight=3.0",
        "params.map.voxel_size=0.7",
        "params.registration.point_spacing=0.8",
        "params.lidar.range_sigma=0.1",
        "params.imu.gyro_noise=0.001",
        "params.point_map.nearer_by=0.0",
        "params.point_map.cube_side_length=12.0",
        "params.lidar.max_range=12.0",
    ],
)
def test_every_value_of_the_recipe_counts(change, drive):
    _, _, poses = run(settings_with(change).params(), count=MOVING)
    assert not np.array_equal(poses, drive[2][:MOVING])
    assert np.isfinite(poses).all()
