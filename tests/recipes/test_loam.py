"""The recipe loam on simulated recordings whose truth is known, and on scans it was not made for."""

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.core.types import LOST
from lio_jax.core.xla import PerShape
from lio_jax.recipes import loam
from lio_jax.recipes.loam import Loam
from lio_jax.run.run import settings_for
from lio_jax.run.scan_inputs import padded
from lio_jax.settings.settings import Settings, recipe_settings, with_extrinsics, with_overrides
from lio_jax.sim.sequence import SimulatedSequence
from tests.params import Config, Params
from tests.recipes.street import ate, recording, truth

SMALL = [
    "config.lidar.buckets=[8192]",
    "config.map.capacity=16384",
    "config.loam.corner_points=2048",
    "config.loam.surface_points=2048",
    "config.features.rings=16",
    "config.features.columns=576",
    "config.features.surface_points=6144",
    "params.lidar.min_range=1.0",
]
SCANS, MOVING = 30, 10


def settings_with(*sets: str) -> Settings:
    T_imu_lidar = recording()[0].info.T_imu_lidar
    return with_overrides(with_extrinsics(recipe_settings("loam"), T_imu_lidar, "test"), [*SMALL, *sets])


CONFIG = settings_with().config
PARAMS = settings_with().params()


@cache
def programs(config: Config):
    """Return init and step, compiled as the runner's are."""
    return PerShape(jax.jit(Loam(config).init)), PerShape(jax.jit(Loam(config).step))


@cache
def arrays():
    """Return each scan's padded arrays."""
    last, inputs = None, []
    for scan in recording()[1]:
        inputs.append(jax.tree.map(jnp.asarray, padded(scan, last, CONFIG.lidar)))
        last = scan.end_ns
    return inputs


def run(
    params: Params = PARAMS,
    change=lambda number, scan: scan,
    count: int = SCANS,
    config: Config = CONFIG,
    start: loam.LoamState | None = None,
):
    """Return states and outputs of each scan, and T_world_imu."""
    init, step = programs(config)
    state, states, outputs = init(params) if start is None else start, [], []
    for number in range(count):
        state, output = step(params, state, change(number, arrays()[number]))
        states.append(state)
        outputs.append(output)
    poses = np.stack([np.asarray(state.nav.T_world_imu.as_matrix()) for state in states])
    return states, outputs, poses


@pytest.fixture(scope="module")
def drive():
    return run()


def test_a_drive_is_tracked(drive):
    states, outputs, poses = drive
    assert np.linalg.norm(truth()[-1, :3, 3] - truth()[0, :3, 3]) > 1
    assert ate(poses) < 0.06
    assert not any(output.lost for output in outputs[1:])
    assert all(output.registration.matches > 200 for output in outputs[1:])
    speed = np.linalg.norm(truth()[-1, :3, 3] - truth()[-2, :3, 3]) / 0.1
    assert np.linalg.norm(states[-1].nav.velocity) == pytest.approx(speed, abs=0.2)


def test_the_map_corrects_the_odometry(drive):
    states, _, poses = drive
    lidar = np.stack([np.asarray(state.T_odom_lidar.as_matrix()) for state in states])
    correction = np.stack([np.asarray(state.T_map_odom.as_matrix()) for state in states])
    T_imu_lidar = np.asarray(states[-1].nav.T_imu_lidar.as_matrix())
    # the map's pose at the middle, carried on to the end by the odometry's velocity
    middle = correction @ lidar @ np.linalg.inv(T_imu_lidar)
    half_a_scan = np.linalg.norm(states[-1].twist[:3]) * 0.05
    apart = np.linalg.norm(middle[-1, :3, 3] - poses[-1, :3, 3])
    assert apart == pytest.approx(half_a_scan, rel=0.05)
    assert np.linalg.norm(correction[-1, :3, 3] - correction[0, :3, 3]) > 1e-3


@pytest.mark.long
def test_mapping_every_third_scan_gives_a_pose_for_every_scan():
    config = replace(CONFIG, loam=replace(CONFIG.loam, mapping_every=3))
    _, outputs, poses = run(config=config)
    assert ate(poses) < 0.15
    added = [int(output.added.sum()) > 0 for output in outputs]
    assert added == [number % 3 == 0 for number in range(SCANS)]
    assert np.linalg.norm(np.diff(poses[MOVING:, :3, 3], axis=0), axis=1).min() > 0.01


@pytest.mark.long
def test_compensation_helps_a_moving_sensor(drive):
    without = run(config=replace(CONFIG, loam=replace(CONFIG.loam, compensate=False)))
    assert not np.array_equal(without[2], drive[2])
    assert ate(drive[2]) < ate(without[2]) + 0.01
    rmse = [np.mean([float(output.registration.rmse) for output in one[1][20:]]) for one in (drive, without)]
    assert rmse[0] < rmse[1]


def empty(scan):
    return eqx.tree_at(lambda s: s.mask, scan, jnp.zeros_like(scan.mask))


def test_an_empty_scan_is_predicted_over(drive):
    states, outputs, poses = run(change=lambda n, scan: empty(scan) if n == 18 else scan)
    assert outputs[18].lost
    assert outputs[18].registration.status == LOST
    for one, other in zip(jax.tree.leaves(states[17].map), jax.tree.leaves(states[18].map), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not outputs[19].lost
    assert ate(poses) < ate(drive[2]) + 0.02
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((states[18].nav, outputs[18].nis)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_ignored(value):
    def spoil(number, scan, bad):
        rows = jnp.arange(len(scan.mask)) % 7 == 3
        if bad:
            return eqx.tree_at(lambda s: s.points, scan, jnp.where(rows[:, None], value, scan.points))
        return eqx.tree_at(lambda s: s.mask, scan, scan.mask & ~rows)

    one, other = (run(change=partial(spoil, bad=bad), count=5) for bad in (True, False))
    for left, right in zip(jax.tree.leaves(one[0][-1]), jax.tree.leaves(other[0][-1]), strict=True):
        np.testing.assert_array_equal(left, right)


def only(scan, keep):
    return eqx.tree_at(lambda s: s.mask, scan, scan.mask & keep(scan))


def thinned_ring(scan):
    """Leave 8 points of ring 5, fewer than a point's neighbourhood."""
    own = scan.ring == 5
    return ~own | (jnp.cumsum(own & scan.mask) <= 8)


def one_sector(scan):
    azimuth = jnp.arctan2(scan.points[:, 1], scan.points[:, 0])
    return jnp.abs(azimuth) < jnp.pi / 6


def test_a_ring_of_a_few_points_does_no_harm(drive):
    _, outputs, poses = run(change=lambda n, scan: only(scan, thinned_ring))
    assert not any(output.lost for output in outputs)
    assert ate(poses) < 0.08


def test_scans_of_a_single_sector_are_matched_or_reported_as_lost():
    _, outputs, poses = run(change=lambda n, scan: only(scan, one_sector), count=20)
    assert np.isfinite(poses).all()
    assert ate(poses) < 0.3
    for output in outputs[1:]:
        assert output.lost or output.registration.matches >= 50


def test_without_any_corner_planes_alone_are_matched():
    """A threshold that no point's smoothness exceeds."""
    _, outputs, poses = run(settings_with("params.features.corner_threshold=1e9").params())
    assert not any(output.lost for output in outputs)
    assert ate(poses) < 0.1


@pytest.mark.parametrize(
    ("sensor", "rings"),
    [pytest.param("vlp8", 8, marks=pytest.mark.long), pytest.param("os1_128", 128, marks=pytest.mark.long)],
)
def test_eight_and_128_beams(sensor, rings):
    if sensor == "vlp8":
        whole = SimulatedSequence("street", duration_s=1.0, beams=8, columns=512, seed=1, standstill_s=0.0)
    else:
        whole = SimulatedSequence("street", sensor, 0.6, seed=1, standstill_s=0.0)
    sets = ["config.loam.corner_points=8192", "config.map.capacity=16384"]
    settings, _ = settings_for(whole, with_overrides(recipe_settings("loam"), sets))
    assert settings.config.features.rings == rings
    init, step = programs(settings.config)
    params = settings.params()
    state, last, poses, stamps = init(params), None, [], []
    for scan in whole.scans():
        state, output = step(
            params, state, jax.tree.map(jnp.asarray, padded(scan, last, settings.config.lidar))
        )
        assert last is None or not output.lost
        last = scan.end_ns
        poses.append(np.asarray(state.nav.T_world_imu.as_matrix()))
        stamps.append(scan.end_ns)
    true = whole.truth().at(np.array(stamps)).poses if hasattr(whole.truth(), "at") else whole.truth().poses
    moved, expected = (np.linalg.inv(rows[0]) @ rows[-1] for rows in (np.stack(poses), true))
    assert np.linalg.norm(moved[:3, 3] - expected[:3, 3]) < 0.1


def test_a_recipe_without_sizes_is_an_error_that_explains_their_source():
    settings = recipe_settings("loam")
    with pytest.raises(UsageError, match="settings_for"):
        Loam(settings.config).init(settings.params())


def test_the_first_map_is_empty():
    state = Loam(CONFIG).init(PARAMS)
    assert not np.isfinite(np.asarray(state.map.cubes.surface.off_centre)).any()
    assert (np.asarray(state.map.last.index.ring) == -1).all()


@pytest.mark.parametrize(
    "change",
    [
        "params.knn.radius=0.6",
        "params.knn.plane_tolerance=0.02",
        "params.knn.line_ratio=20",
        "params.map.voxel_size=0.5",
        "params.map.corner_voxel_size=0.6",
        "params.registration.kernel=0.02",
        "params.scan_to_scan.radius=0.3",
        "params.scan_to_scan.rings_apart=1.5",
        "params.features.surface_spacing=0.4",
        "params.point_map.nearer_by=0.0",
        "params.cubes.edge=4",
    ],
)
def test_every_value_of_the_recipe_counts(change, drive):
    _, _, poses = run(settings_with(change).params(), count=MOVING)
    assert not np.array_equal(poses, drive[2][:MOVING])
    assert np.isfinite(poses).all()
