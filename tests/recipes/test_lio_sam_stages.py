"""Each stage of LIO-SAM alone, against closed forms and the numbers of the published program."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.error_state import DOF, NavEstimate
from lio_jax.core.types import CONVERGED, LOST, ImuBatch, Scan, initial_nav_state
from lio_jax.estimation.latest_error import LatestError
from lio_jax.lidar.features import FeatureCloud
from lio_jax.mapping.feature_map import FeaturePoints, Submap, empty_feature_map
from lio_jax.mapping.keyframes import no_keyframes
from lio_jax.recipes import lio_sam_stages as stages
from lio_jax.recipes.lio_sam_stages import Clock, Features, LioSamState, MapMatch
from lio_jax.recipes.smoothed_odometry import opened, unknowns_covariance
from lio_jax.registration.gauss_newton import Registration
from lio_jax.settings.settings import recipe_settings, with_overrides

CORNERS, SURFACES, SAMPLES = 256, 1024, 11
SETTINGS = with_overrides(
    recipe_settings("lio_sam"),
    [
        f"config.lio_sam.corner_points={CORNERS}",
        f"config.lio_sam.surface_points={SURFACES}",
        "config.lio_sam.window=4",
        "config.lio_sam.keyframes=4",
        "config.map.capacity=4096",
        "params.extrinsics.translation=[0.3, -0.1, 0.2]",
    ],
)
CONFIG, PARAMS = SETTINGS.config, SETTINGS.params()
PERIOD, GRAVITY = 0.1, 9.80665
START, SPEED = np.array([2.0, -1.0, 0.5]), np.array([3.0, 0.4, 0.0])
_smooth = jax.jit(partial(stages.smooth, CONFIG))
_match = jax.jit(partial(stages.scan_to_map, CONFIG))
_keyframe = jax.jit(stages.keyframe)


def pose(translation, turn=(0.0, 0.0, 0.0)) -> jaxlie.SE3:
    rotation = jaxlie.SO3.exp(jnp.asarray(turn, jnp.float64))
    return jaxlie.SE3.from_rotation_and_translation(rotation, jnp.asarray(translation, jnp.float64))


def state(T_world_imu=None, velocity=SPEED, scans=5, time=1.0, matched_at=0.9) -> LioSamState:
    """Return a state whose smoother agrees with its navigation state."""
    nav = initial_nav_state(PARAMS.extrinsics.T_imu_lidar(), GRAVITY)
    T_world_imu = pose(START) if T_world_imu is None else T_world_imu
    nav = replace(nav, T_world_imu=T_world_imu, velocity=jnp.asarray(velocity))
    keyframes = no_keyframes(CONFIG.lio_sam.keyframes, CORNERS, SURFACES, jnp.dtype(jnp.float64))
    initial = PARAMS.initial
    sigmas = (1e-2, 1e-2, initial.velocity_sigma, initial.gyro_bias_sigma, initial.accel_bias_sigma)
    sigmas = [*np.repeat(sigmas, 3), *[float(initial.gravity_sigma)] * 2, *[0.0] * (DOF - 17)]
    start = NavEstimate(nav, jnp.diag(jnp.asarray(sigmas) ** 2))
    return LioSamState(
        nav=nav,
        window=opened(CONFIG, PARAMS, start),
        time=jnp.asarray(time),
        matched_at=jnp.asarray(matched_at),
        scans=jnp.int32(scans),
        error=LatestError.of(unknowns_covariance(start)),
        map=Submap(keyframes, empty_feature_map(CONFIG.map.capacity)),
    )


def clock(first=False, time=1.1) -> Clock:
    interval = 0.0 if first else PERIOD
    return Clock(jnp.array(first), jnp.asarray(PERIOD), jnp.asarray(interval), jnp.asarray(time))


def samples(gyro=(0.0, 0.0, 0.0), accel=(0.0, 0.0, GRAVITY)) -> ImuBatch:
    """Return samples that read the same all along."""
    return ImuBatch(
        time=jnp.linspace(0.0, PERIOD, SAMPLES),
        gyro=jnp.tile(jnp.asarray(gyro), (SAMPLES, 1)),
        accel=jnp.tile(jnp.asarray(accel), (SAMPLES, 1)),
        mask=jnp.ones(SAMPLES, bool),
    )


def room(seed: int = 0) -> FeaturePoints:
    """Return points of a box of 8 x 6 x 4 m around the world's origin: its upright edges and its faces."""
    rng = np.random.default_rng(seed)
    half = np.array([4.0, 3.0, 2.0])
    corner = half * rng.choice([-1.0, 1.0], (CORNERS, 3))
    corner[:, 2] = rng.uniform(-2.0, 2.0, CORNERS)
    surface = half * rng.uniform(-0.95, 0.95, (SURFACES, 3))
    axis = rng.integers(0, 3, SURFACES)
    surface[np.arange(SURFACES), axis] = (half * rng.choice([-1.0, 1.0], (SURFACES, 3)))[
        np.arange(SURFACES), axis
    ]
    return FeaturePoints(
        jnp.asarray(corner, jnp.float32),
        jnp.ones(CORNERS, bool),
        jnp.asarray(surface, jnp.float32),
        jnp.ones(SURFACES, bool),
    )


def seen_from(T_world_lidar: jaxlie.SE3, points: FeaturePoints) -> FeaturePoints:
    back = T_world_lidar.inverse()
    corner, surface = (
        back.apply(kind.astype(jnp.float64)).astype(jnp.float32) for kind in (points.corner, points.surface)
    )
    return replace(points, corner=corner, surface=surface)


def features(enough=True, seen=True) -> Features:
    def cloud(count: int) -> FeatureCloud:
        return FeatureCloud(
            points=jnp.zeros((count, 3), jnp.float32),
            time=jnp.zeros(count, jnp.float32),
            ring=jnp.zeros(count, jnp.int32),
            mask=jnp.ones(count, bool),
        )

    none = jnp.int32(0)
    return Features(cloud(CORNERS), cloud(SURFACES), jnp.array(enough), jnp.array(seen), none)


def match(T_world_imu, used=True, lost=False, new_piece=False) -> MapMatch:
    registration = Registration(
        T_world_lidar=T_world_imu,
        information=1e4 * jnp.eye(6),
        degenerate=jnp.zeros(6, bool),
        matches=jnp.int32(500),
        rmse=jnp.asarray(0.01),
        blur=jnp.asarray(1e-6),
        iterations=jnp.int32(3),
        status=jnp.int32(LOST if lost else CONVERGED),
    )
    return MapMatch(registration, T_world_imu, *map(jnp.array, (used, lost, new_piece)), matched=None)


def mapped(T_world_lidar=None) -> LioSamState:
    """Return a state whose map holds the room, as a keyframe at a pose of the sensor."""
    before, sensor = state(), T_world_lidar or pose([0.2, 0.1, 0.0])
    added = _keyframe(
        PARAMS,
        replace(before, scans=jnp.int32(0)),
        clock(first=True, time=0.0),
        seen_from(sensor, room()),
        replace(before.nav, T_world_imu=sensor @ before.nav.T_imu_lidar.inverse()),
        features(),
        match(sensor, used=False),
        jnp.array(False),
    )
    return replace(before, map=added.submap)


def test_the_clock_counts_from_the_first_scans_end():
    scan = Scan(
        points=jnp.zeros((1, 3), jnp.float32),
        time=jnp.zeros(1, jnp.float32),
        ring=jnp.zeros(1, jnp.int32),
        intensity=jnp.zeros(1, jnp.float32),
        mask=jnp.ones(1, bool),
        duration=jnp.float32(0.125),
        interval=jnp.float32(0.25),
    )
    later, first = stages.clock_at(state(time=1.0), scan), stages.clock_at(state(scans=0, time=0.0), scan)
    assert (float(later.end), float(later.interval), float(later.time)) == (0.125, 0.25, 1.25)
    assert (float(first.interval), float(first.time), bool(first.first)) == (0.0, 0.0, True)


def test_the_prediction_is_that_of_constant_acceleration():
    """p + v t + R a t^2 / 2: level, so that the specific force is the acceleration plus gravity."""
    accel = np.array([0.5, -0.3, 0.2])
    found = stages.predict(state(), clock(), samples(accel=accel + np.array([0, 0, GRAVITY])))
    expected = START + SPEED * PERIOD + accel * PERIOD**2 / 2
    np.testing.assert_allclose(found.T_world_imu.translation(), expected, atol=1e-9)
    np.testing.assert_allclose(found.velocity, SPEED)


def test_the_prediction_turns_as_the_gyroscope_says():
    found = stages.predict(state(), clock(), samples(gyro=(0.0, 0.0, 0.4)))
    np.testing.assert_allclose(found.T_world_imu.rotation().log(), [0, 0, 0.4 * PERIOD], atol=1e-9)


def test_the_increment_of_the_smoother_is_applied_to_the_matched_pose():
    """Matched pose and smoother differ by a turn: the increment counts in the body's axes."""
    turned = pose([10.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2])
    before = state()
    before = replace(before, nav=replace(before.nav, T_world_imu=turned))
    found = stages.predict(before, clock(), samples())
    expected = np.array([10.0, 0.0, 0.0]) + PERIOD * np.array([-SPEED[1], SPEED[0], SPEED[2]])
    np.testing.assert_allclose(found.T_world_imu.translation(), expected, atol=1e-9)


def test_the_first_scan_is_at_the_start():
    before = state(scans=0, time=0.0)
    found = stages.predict(before, clock(first=True, time=0.0), samples(accel=(5.0, 0.0, GRAVITY)))
    np.testing.assert_array_equal(found.T_world_imu.wxyz_xyz, before.nav.T_world_imu.wxyz_xyz)


def test_features_are_moved_to_where_the_sensor_was_at_the_end():
    """At constant velocity a point of time t lies (end - t) v nearer, its rotation being that of the IMU."""
    found = stages.predict(state(), clock(), samples())
    times = np.linspace(0.0, PERIOD, CORNERS).astype(np.float32)
    points = np.random.default_rng(0).uniform(-20, 20, (CORNERS, 3)).astype(np.float32)
    picked = features()
    corner = replace(picked.corner, points=jnp.asarray(points), time=jnp.asarray(times))
    got = stages.compensated(replace(picked, corner=corner), found.path, state().nav.T_imu_lidar)
    np.testing.assert_allclose(got.corner, points - (PERIOD - times)[:, None] * SPEED, atol=1e-5)


@pytest.fixture(scope="module")
def with_map() -> LioSamState:
    return mapped()


def matched_from(
    before: LioSamState, truth: jaxlie.SE3, off: jaxlie.SE3, params=PARAMS, enough=True, **times
):
    """Return the match of the room seen from a pose of the IMU, predicted wrongly."""
    points = seen_from(truth @ before.nav.T_imu_lidar, room())
    guess = jaxlie.SE3((truth @ off).wxyz_xyz)
    prediction = replace(stages.predict(before, clock(), samples()), T_world_imu=guess)
    return _match(params, before, clock(**times), points, prediction, samples(), jnp.array(enough))


TRUTH = pose([-0.2, 0.15, -0.1], [0.01, -0.02, 0.1])
OFF = pose([0.05, -0.04, 0.03], [0.005, 0.004, -0.01])


def test_a_known_pose_comes_back_from_the_map(with_map):
    found = matched_from(with_map, TRUTH, OFF)
    assert found.used
    assert not found.lost
    missed = np.asarray((TRUTH.inverse() @ found.T_world_imu).log())
    assert np.linalg.norm(missed[:3]) < 0.01
    assert np.linalg.norm(missed[3:]) < 0.002


def test_the_prediction_stands_until_a_match_is_due(with_map):
    """LIO-SAM matches at most once in mappingProcessInterval, 0.15 s."""
    params = eqx.tree_at(lambda p: p.smoother.mapping_interval, PARAMS, jnp.asarray(0.15))
    early = matched_from(replace(with_map, matched_at=jnp.asarray(1.0)), TRUTH, OFF, params)
    assert not early.used
    assert not early.lost
    np.testing.assert_array_equal(early.T_world_imu.wxyz_xyz, (TRUTH @ OFF).wxyz_xyz)
    assert matched_from(replace(with_map, matched_at=jnp.asarray(0.9)), TRUTH, OFF, params).used


@pytest.mark.parametrize(("empty", "enough"), [(True, True), (False, False)])
def test_without_map_or_features_the_scan_is_lost(with_map, empty, enough):
    before = state() if empty else with_map
    found = matched_from(before, TRUTH, OFF, enough=enough)
    assert found.lost
    assert not found.used
    np.testing.assert_array_equal(found.T_world_imu.wxyz_xyz, (TRUTH @ OFF).wxyz_xyz)
    assert not matched_from(before, TRUTH, OFF, enough=enough, first=True).lost


def test_height_is_cut_off_at_its_limit(with_map):
    """z_tollerance bounds the lidar's height, as in the published program."""
    params = eqx.tree_at(lambda p: p.smoother.height_limit, PARAMS, jnp.asarray(0.01))
    found = matched_from(with_map, TRUTH, OFF, params)
    lidar = found.T_world_imu @ with_map.nav.T_imu_lidar
    # drawing the tilt turns the IMU about itself: the lever arm moves the lidar by less than a millimetre
    assert float(lidar.translation()[2]) == pytest.approx(0.01, abs=1e-3)


def smoothed_from(before: LioSamState, found: MapMatch, imu=None, now=None):
    now, imu = now or clock(), imu or samples()
    return _smooth(PARAMS, before, now, room(), stages.predict(before, now, imu), imu, found)


def test_a_match_where_the_samples_lead_changes_nothing():
    """The window's latest state is then the prediction itself: residuals of both kinds vanish."""
    expected = START + PERIOD * SPEED
    found = smoothed_from(state(), match(pose(expected)))
    latest = found.window.latest()
    assert not found.failed
    assert int(found.window.chain.count) == 2
    assert found.smoothed.status == CONVERGED
    np.testing.assert_allclose(latest.velocity, SPEED, atol=1e-6)
    np.testing.assert_allclose(latest.T_world_imu.translation(), expected, atol=1e-6)
    np.testing.assert_allclose(latest.accel_bias, 0, atol=1e-6)


def test_a_match_corrects_the_velocity():
    """The first velocity is all but unknown: two matched positions determine it, v = (p1 - p0) / t."""
    faster = SPEED + np.array([0.5, 0.0, 0.0])
    found = smoothed_from(state(), match(pose(START + PERIOD * faster)))
    sigma = float(PARAMS.initial.velocity_sigma)
    assert sigma > 1
    np.testing.assert_allclose(found.window.latest().velocity, faster, atol=0.1)
    np.testing.assert_allclose(found.T_world_imu.translation(), START + PERIOD * faster, atol=1e-3)


def test_a_velocity_beyond_the_limit_begins_anew_where_the_old_one_leads():
    too_fast = float(PARAMS.limits.speed) + 5.0
    before = state(velocity=[too_fast, 0.0, 0.0])
    expected = START + PERIOD * np.array([too_fast, 0, 0])
    found = smoothed_from(before, match(pose(expected)))
    assert found.failed
    assert int(found.window.chain.count) == 1
    np.testing.assert_allclose(found.T_world_imu.translation(), expected)
    np.testing.assert_array_equal(found.window.latest().velocity, 0)


def test_the_first_scan_leaves_the_window_as_it_is():
    before = state(scans=0, time=0.0)
    found = smoothed_from(before, match(pose(START), used=False), now=clock(first=True, time=0.0))
    assert not found.failed
    for old, new in zip(jax.tree.leaves(before.window), jax.tree.leaves(found.window), strict=True):
        np.testing.assert_array_equal(old, new)


def added_at(
    before: LioSamState, T_world_lidar: jaxlie.SE3, found: MapMatch, *, now=None, enough=True, failed=False
):
    nav = replace(before.nav, T_world_imu=T_world_lidar @ before.nav.T_imu_lidar.inverse())
    points, now = seen_from(T_world_lidar, room()), now or clock()
    picked = features(enough=enough)
    submap = _keyframe(PARAMS, before, now, points, nav, picked, found, jnp.array(failed)).submap
    return int(jnp.sum(jnp.isfinite(submap.keyframes.time)))


FIRST_KEYFRAME = pose([0.2, 0.1, 0.0])


@pytest.mark.parametrize(
    ("moved", "turned", "keyframes"), [(0.95, 0.0, 1), (1.05, 0.0, 2), (0.0, 0.19, 1), (0.0, 0.21, 2)]
)
def test_a_keyframe_is_made_after_a_metre_or_a_fifth_of_a_radian(with_map, moved, turned, keyframes):
    """The published program's surroundingkeyframeAddingDistThreshold and -AngleThreshold."""
    T = FIRST_KEYFRAME @ pose([moved, 0.0, 0.0], [0.0, 0.0, turned])
    assert added_at(with_map, T, match(T)) == keyframes


def test_an_unused_match_or_a_failure_makes_no_keyframe(with_map):
    T = FIRST_KEYFRAME @ pose([2.0, 0.0, 0.0])
    assert added_at(with_map, T, match(T)) == 2
    assert added_at(with_map, T, match(T, used=False)) == 1
    assert added_at(with_map, T, match(T), failed=True) == 1


def test_a_lost_scan_begins_a_new_piece_of_map_after_an_outage(with_map):
    T = FIRST_KEYFRAME @ pose([2.0, 0.0, 0.0])
    assert added_at(with_map, T, match(T, used=False, lost=True)) == 1
    assert added_at(with_map, T, match(T, used=False, lost=True, new_piece=True)) == 2


def test_a_new_piece_of_map_waits_for_an_outage_and_needs_features(with_map):
    since, outage = float(with_map.matched_at), float(PARAMS.limits.outage)
    away = pose([60.0, 0.0, 0.0])

    def seen(share, enough=True):
        return matched_from(with_map, TRUTH, away, time=since + share * outage, enough=enough)

    assert bool(seen(0.9).lost)
    assert not bool(seen(0.9).new_piece)
    assert bool(seen(1.1).new_piece)
    assert not bool(seen(1.1, enough=False).new_piece)
