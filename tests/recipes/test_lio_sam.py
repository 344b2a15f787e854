"""The recipe lio_sam on simulated recordings whose truth is known."""

import re
from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.error_state import ACCEL_BIAS, GYRO_BIAS, POSITION, ROTATION, VELOCITY
from lio_jax.core.errors import UsageError
from lio_jax.core.types import ImuBatch
from lio_jax.core.xla import PerShape
from lio_jax.mapping.feature_map import empty_feature_map
from lio_jax.recipes.lio_sam import LioSam
from lio_jax.recipes.smoothed_odometry import match_as_measurement
from lio_jax.run.scan_inputs import ImuFeed, padded
from lio_jax.settings.settings import Settings, recipe_settings, with_extrinsics, with_overrides
from tests.params import DEFAULTS, Params
from tests.recipes.street import ate, recording, truth

SMALL = [
    "config.lidar.buckets=[8192]",
    "config.imu.buckets=[64]",
    "config.map.capacity=16384",
    "config.lio_sam.window=4",
    "config.lio_sam.keyframes=16",
    "config.lio_sam.corner_points=1024",
    "config.lio_sam.surface_points=2048",
    "config.features.rings=16",
    "config.features.columns=576",
    "config.features.surface_points=6144",
]
SCANS, MOVING = 30, 12


def settings_with(*sets: str) -> Settings:
    T_imu_lidar = recording()[0].info.T_imu_lidar
    return with_overrides(with_extrinsics(recipe_settings("lio_sam"), T_imu_lidar, "test"), [*SMALL, *sets])


CONFIG = settings_with().config
PARAMS = settings_with().params()
# compiled as the runner's are
INIT = PerShape(jax.jit(LioSam(CONFIG).init))
STEP = PerShape(jax.jit(LioSam(CONFIG).step))


@cache
def arrays():
    """Return each scan's padded arrays and its samples, and the samples before the first."""
    _, scans, imu = recording()
    feed, last, inputs = ImuFeed(imu, CONFIG.imu.buckets, 0.0, 0.0), None, []
    for scan in scans:
        pair = padded(scan, last, CONFIG.lidar), feed.batch(scan, last)
        inputs.append(jax.tree.map(jnp.asarray, pair))
        last = scan.end_ns
    return inputs, jax.tree.map(jnp.asarray, feed.before(scans[0]))


def run(params: Params = PARAMS, change=lambda number, scan, imu: (scan, imu), count: int = SCANS):
    """Return states and outputs of each scan, and T_world_imu."""
    inputs, before = arrays()
    state, states, outputs = INIT(params, before), [], []
    for number in range(count):
        state, output = STEP(params, state, *change(number, *inputs[number]))
        states.append(state)
        outputs.append(output)
    poses = np.stack([np.asarray(state.nav.T_world_imu.as_matrix()) for state in states])
    return states, outputs, poses


@pytest.fixture(scope="module")
def drive():
    return run()


CORRECT = PerShape(jax.jit(LioSam(CONFIG).corrected))


@pytest.mark.parametrize(
    ("yaw", "position", "most_turned", "most_moved"),
    [
        # the grids of both maps, 1.2 m and 0.6 m, lie on themselves: the maps hold the same points
        (0.0, (12.0, -24.0, 3.6), 1e-3, 1e-3),
        (np.pi / 2, (1.2, 2.4, 0.0), 1e-3, 1e-3),
        # other points survive the thinning
        (0.1, (3.3, -1.7, 0.25), 2e-3, 0.03),
    ],
)
def test_a_rigid_correction_moves_the_next_scans_rigidly(drive, yaw, position, most_turned, most_moved):
    inputs, _ = arrays()
    states, outputs, poses = drive
    last = SCANS - 3
    T = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_z_radians(jnp.asarray(yaw)), jnp.asarray(position)
    )
    keyframes = T @ states[last].map.keyframes.T_world_lidar
    state = CORRECT(PARAMS, states[last], T, keyframes)
    own_axes = [one.nav.T_world_imu.rotation().inverse() @ one.nav.velocity for one in (state, states[last])]
    np.testing.assert_allclose(*own_axes, atol=1e-12)
    np.testing.assert_array_equal(state.map.keyframes.corner, states[last].map.keyframes.corner)
    for number in (last + 1, last + 2):
        state, output = STEP(PARAMS, state, *inputs[number])
        apart = np.linalg.inv(np.asarray(T.as_matrix()) @ poses[number]) @ state.nav.T_world_imu.as_matrix()
        assert not output.lost
        assert Rotation.from_matrix(apart[:3, :3]).magnitude() < most_turned
        assert np.linalg.norm(apart[:3, 3]) < most_moved
        sigma = np.sqrt(np.diagonal(outputs[number].covariance))
        # three scans tell little of the biases: maps of the same points leave them within a tenth of a sigma
        share = 0.1 if most_moved < 0.01 else 1.0
        for name, part in (("gyro_bias", GYRO_BIAS), ("accel_bias", ACCEL_BIAS)):
            apart = getattr(state.nav, name) - getattr(states[number].nav, name)
            assert (np.abs(apart) < share * sigma[part]).all()


def speed_at(number: int) -> float:
    """Return the speed at a scan's end: the vehicle accelerates, so that it is above the interval's mean."""
    last, before = (
        np.linalg.norm(truth()[k, :3, 3] - truth()[k - 1, :3, 3]) / 0.1 for k in (number, number - 1)
    )
    return float(last + (last - before) / 2)


def test_a_drive_is_tracked(drive):
    states, outputs, poses = drive
    assert np.linalg.norm(truth()[-1, :3, 3] - truth()[0, :3, 3]) > 1
    assert ate(poses) < 0.03
    assert not any(output.lost for output in outputs)
    assert all(output.registration.matches > 200 for output in outputs[1:])
    assert np.linalg.norm(states[-1].nav.velocity) == pytest.approx(speed_at(SCANS - 1), abs=0.15)


def test_the_world_is_level(drive):
    _, _, poses = drive
    up = np.einsum("nij,nj->ni", poses[:, :3, :3], truth()[:, 2, :3])
    tilt = np.arccos(np.clip(up[:, 2], -1, 1))
    assert np.degrees(tilt).max() < 0.5


def test_keyframes_are_a_metre_apart_and_the_rest_leaves_the_map_alone(drive):
    states, outputs, poses = drive
    made = [bool(output.added.any()) for output in outputs]
    last = poses[0]
    for number in range(1, SCANS):
        between = np.linalg.inv(last) @ poses[number]
        angle = Rotation.from_matrix(between[:3, :3]).magnitude()
        # the lidar's own distance differs by the lever arm's
        far = np.linalg.norm(between[:3, 3]) > 1.05 or angle > 0.22
        near = np.linalg.norm(between[:3, 3]) < 0.95 and angle < 0.18
        assert made[number] or not far
        assert not (made[number] and near)
        if made[number]:
            last = poses[number]
    assert made[0]
    assert 1 < sum(made) < SCANS / 2
    held = int(np.sum(np.isfinite(np.asarray(states[-1].map.keyframes.time))))
    assert held == sum(made)


def test_velocity_and_biases_have_a_covariance_that_shrinks(drive):
    _, outputs, _ = drive
    first, last = (np.sqrt(np.diagonal(np.asarray(outputs[k].covariance))) for k in (2, SCANS - 1))
    for part in (ROTATION, POSITION, VELOCITY, GYRO_BIAS, ACCEL_BIAS):
        assert (last[part] > 0).all()
    assert (last[VELOCITY] < 0.7 * first[VELOCITY]).all()
    # a walk of 3 s is all that was added
    assert (last[GYRO_BIAS] < 1.1 * first[GYRO_BIAS]).all()


def test_matching_at_most_every_quarter_second_leaves_the_rest_to_the_samples(drive):
    states, _, poses = run(settings_with("params.smoother.mapping_interval=0.25").params())
    matched = [float(state.matched_at) for state in states]
    np.testing.assert_allclose(np.diff(sorted(set(matched)))[1:], 0.3, atol=1e-6)
    assert ate(poses) < 0.06
    assert np.abs(poses - drive[2]).max() > 1e-5


def emptied(scan):
    return replace(scan, mask=jnp.zeros_like(scan.mask))


@pytest.mark.parametrize("value", [jnp.nan, jnp.inf])
def test_points_that_are_not_finite_are_ignored(value):
    def damaged(number, scan, imu):
        bad = jnp.arange(len(scan.points)) % 7 == 3
        points = jnp.where(bad[:, None], value, scan.points)
        return replace(scan, points=points, mask=scan.mask & ~bad), imu

    _, outputs, poses = run(change=damaged, count=MOVING + 4)
    assert np.isfinite(poses).all()
    assert not any(output.lost for output in outputs)
    assert ate(poses) < 0.03


def test_a_torn_first_scan_does_not_become_the_map():
    def torn(number, scan, imu):
        few = scan.mask & (jnp.arange(len(scan.mask)) < 300)
        return (replace(scan, mask=few) if number == 0 else scan), imu

    states, outputs, _ = run(change=torn, count=6)
    assert [int(state.scans) for state in states] == [0, 1, 2, 3, 4, 5]
    assert not any(output.lost for output in outputs[2:])
    assert all(np.isfinite(np.asarray(output.covariance)).all() for output in outputs)


def silent(imu: ImuBatch) -> ImuBatch:
    return replace(imu, mask=jnp.zeros_like(imu.mask))


def test_missing_samples_are_bridged_by_the_velocity():
    gap = range(MOVING, MOVING + 2)
    states, outputs, poses = run(change=lambda k, scan, imu: (scan, silent(imu) if k in gap else imu))
    assert np.isfinite(poses).all()
    assert not any(output.lost for output in outputs)
    assert ate(poses) < 0.05
    assert np.linalg.norm(states[-1].nav.velocity) == pytest.approx(speed_at(SCANS - 1), abs=0.3)


def test_two_scans_of_one_instant_change_nothing():
    def twice(number, scan, imu):
        if number == MOVING:
            # the scan before once more
            scan, imu = arrays()[0][MOVING - 1]
            scan = replace(scan, interval=jnp.zeros_like(scan.interval))
        elif number > MOVING:
            scan, imu = arrays()[0][number - 1]
        return scan, imu

    _, _, poses = run(change=twice, count=MOVING + 6)
    np.testing.assert_allclose(poses[MOVING, :3, 3], poses[MOVING - 1, :3, 3], atol=0.01)
    reference = run(count=MOVING + 5)[2]
    np.testing.assert_allclose(poses[-1, :3, 3], reference[-1, :3, 3], atol=0.02)


def test_a_runaway_bias_starts_the_smoother_anew():
    def shaken(number, scan, imu):
        wild = replace(imu, accel=imu.accel + 700.0)
        return scan, wild if number == MOVING else imu

    states, outputs, poses = run(change=shaken)
    assert np.isfinite(poses).all()
    counts = [int(state.window.chain.count) for state in states]
    assert counts[MOVING - 1] == 4
    assert 1 in counts[MOVING:]
    assert counts[-1] == 4
    assert np.abs(np.asarray(states[-1].nav.accel_bias)).max() < 1.0
    restarted = [bool(output.restarted) for output in outputs]
    assert restarted.index(True) >= MOVING
    assert not outputs[restarted.index(True)].added.any()
    # the wild samples foretell 3.5 m, and a match that begins there ends elsewhere
    assert ate(poses) < 0.03
    for output in outputs:
        assert np.isfinite(np.asarray(output.covariance)).all()
        assert np.isfinite(float(output.log_evidence))


@pytest.mark.long
def test_fixed_sigmas_in_place_of_information():
    chosen = settings_with("config.lio_sam.lidar_noise=fixed")
    step = PerShape(jax.jit(LioSam(chosen.config).step))
    inputs, before = arrays()
    state, params = INIT(chosen.params(), before), chosen.params()
    for number in range(MOVING):
        state, fixed = step(params, state, *inputs[number])
    by_information = run(count=MOVING)[1][-1].covariance
    assert np.sqrt(by_information[3, 3]) < 0.5 * np.sqrt(fixed.covariance[3, 3])


@pytest.mark.parametrize("weak", [0, 1])
def test_a_degenerate_direction_has_no_information(weak):
    """By its information: seen from the IMU, which is turned and apart from the sensor."""
    params = settings_with("config.lio_sam.lidar_noise=information").params()
    config = settings_with("config.lio_sam.lidar_noise=information").config
    lidar = np.diag([4e4, 5e4, 6e4, 300.0, 2e3, 3e3])
    match = replace(no_match(), information=jnp.asarray(lidar), degenerate=jnp.arange(6) < weak)
    params = eqx.tree_at(lambda p: p.registration.degeneracy_ratio, params, jnp.array(0.2))
    found = match_as_measurement(
        config, params, jaxlie.SE3.identity(), match, jnp.array(20.0), jnp.array(True)
    ).information
    T = np.asarray(params.extrinsics.T_imu_lidar().as_matrix())
    # the IMU's perturbations that move the sensor along its own x, y and z, without turning it
    along = np.concatenate([np.zeros((3, 3)), T[:3, :3]])
    seen = np.diag(along.T @ found @ along) / float(params.registration.information_scale)
    expected = np.diag(lidar)[3:] * [1 - weak, 1, 1]
    np.testing.assert_allclose(seen, expected, rtol=1e-9, atol=1e-6)


def no_match():
    registration = jax.eval_shape(LioSam(CONFIG).step, PARAMS, *shapes())[1].registration
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), registration)


def shapes():
    inputs, before = arrays()
    return (INIT(PARAMS, before), *inputs[0])


def test_ground_that_the_map_does_not_hold_is_mapped_after_a_while():
    """A map that is lost stands for an outage in which the vehicle left it behind."""
    inputs, before = arrays()
    state, lost, added, poses = INIT(PARAMS, before), [], [], []
    for number in range(SCANS):
        if number == MOVING:
            nothing = empty_feature_map(CONFIG.map.capacity)
            state = eqx.tree_at(lambda s: s.map.features, state, nothing)
        state, output = STEP(PARAMS, state, *inputs[number])
        lost.append(bool(output.lost))
        added.append(bool(output.added.any()))
        poses.append(np.asarray(state.nav.T_world_imu.as_matrix()))
    again = added.index(True, MOVING)
    assert all(lost[MOVING : again + 1])
    assert again - (MOVING - 1) >= 10 * DEFAULTS["limits"]["outage"]
    assert not any(lost[again + 1 :])
    assert again < SCANS - 3
    assert ate(np.stack(poses)) < 0.1


def test_single_precision_states_are_refused():
    with jax.enable_x64(False), pytest.raises(UsageError, match=r"lio_sam needs double precision.*x64"):
        LioSam(CONFIG).init(settings_with().params(), arrays()[1])


def test_a_nine_axis_imu_levels_the_first_pose():
    _, before = arrays()
    attitude = Rotation.from_euler("ZYX", [0.7, 0.05, -0.1])
    nine = replace(before, orientation=jnp.tile(jnp.asarray(attitude.as_quat()), (len(before.time), 1)))
    for heading, yaw in ((False, 0.0), (True, 0.7)):
        config = settings_with(f"config.imu.heading={str(heading).lower()}").config
        state = jax.jit(LioSam(config).init)(PARAMS, nine)
        found = Rotation.from_matrix(np.asarray(state.nav.T_world_imu.rotation().as_matrix()))
        np.testing.assert_allclose(found.as_euler("ZYX"), [yaw, 0.05, -0.1], atol=1e-9)


def test_without_samples_the_error_names_another_recipe():
    with pytest.raises(UsageError, match=r"lio_sam needs inertial samples.*take loam"):
        LioSam(CONFIG).init(PARAMS, None)


def test_a_recipe_without_sizes_is_an_error_that_explains_their_source():
    with pytest.raises(UsageError, match=re.escape("settings_for(sequence, settings)")):
        LioSam(recipe_settings("lio_sam").config).init(PARAMS, arrays()[1])


def test_a_restart_gives_the_window_the_velocity(drive):
    states, _, _ = drive
    fresh = INIT(PARAMS, arrays()[1]).with_velocity_of(states[-1])
    np.testing.assert_array_equal(fresh.nav.velocity, states[-1].nav.velocity)
    np.testing.assert_array_equal(fresh.window.latest().velocity, states[-1].nav.velocity)
