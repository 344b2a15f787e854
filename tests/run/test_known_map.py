"""A run in the map of an earlier run: the start is found, and the trajectory lies in the map's world."""

import json
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.error_state import sphere_basis
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.geometry import rotation_matrix
from lio_jax.mapping.voxel_map import FREE
from lio_jax.recipes.recipe import LocalisingRecipe
from lio_jax.run import known_map
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.known_map import KnownMap, MapPager
from lio_jax.run.localise import localise, step_of
from lio_jax.run.map_file import write_cloud
from lio_jax.run.pushed import PushedOdometry
from lio_jax.run.run import run_sequence, settings_for
from lio_jax.run.scan_inputs import feed_of
from lio_jax.settings.settings import recipe_of, recipe_settings, with_extrinsics, with_overrides
from lio_jax.tuning.gradient import gradient
from tests.run import inertial_drive
from tests.run.inertial_drive import InertialReplay, errors
from tests.run.test_resume import contents, killed_at, often, resumable

__all__ = ["often"]

LATER = 15
"""Number of the scan with which the second run begins: the vehicle pulls away then."""


@pytest.fixture(scope="module")
def recording():
    return InertialReplay(inertial_drive.scans(), inertial_drive.imu())


@pytest.fixture(scope="module")
def resolved(recording):
    return settings_for(recording, recipe_settings("default"))[0]


@pytest.fixture(scope="module")
def earlier(tmp_path_factory, recording, resolved):
    """Return the folder and the trajectory of a run that has made a map."""
    out = tmp_path_factory.mktemp("earlier")
    return out, run_sequence(recording, resolved, out).trajectory


@pytest.fixture
def known(resolved, earlier):
    return with_overrides(resolved, [f"config.known_map.path={earlier[0]}"])


def near(trajectory, number, off=(0.0, 0.0, 0.0), turned=0.0):
    """Return settings of a start beside the pose of a scan."""
    pose = trajectory.poses[number]
    position = (pose[:3, 3] + off).round(3).tolist()
    heading = np.arctan2(pose[1, 0], pose[0, 0]) + turned
    return [f"params.known_map.position={position}", f"params.known_map.heading={heading:.3f}"]


@pytest.mark.parametrize("way", ["search", "near"])
def test_a_start_is_found_in_the_map(tmp_path, recording, known, earlier, way):
    extra = ["config.known_map.search=true"]
    if way == "near":
        extra = near(earlier[1], LATER, (2.5, -2.0, 0.4), 0.3)
    said = []
    run = run_sequence(recording, with_overrides(known, extra), tmp_path, LATER, notify=said.append)
    assert said[0].startswith("note: the first scan lies in the known map at [")
    # in the world of the earlier run, not aligned: its own errors there are 1 cm
    assert errors(run.trajectory, earlier[1]).max() < 0.03
    start = json.loads((tmp_path / "metrics.json").read_text())["start_in_known_map"]
    assert np.linalg.norm(np.subtract(start["position"], earlier[1].poses[LATER, :3, 3])) < 0.5
    assert 0.9 < start["overlap"] <= 1


def test_the_run_follows_a_map_that_is_moved_and_turned(tmp_path, recording, known, earlier):
    """The world is the map's: its origin and heading are free, and nothing else changes."""
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_euler("z", 2.0).as_matrix()
    moved[:3, 3] = 1200.0, -700.0, 55.0
    points = KnownMap.read(earlier[0]).points
    cloud = (points @ moved[:3, :3].T + moved[:3, 3]).astype(np.float32)
    write_cloud(tmp_path / "moved.ply", [cloud], len(cloud))
    start = replace(earlier[1], poses=moved @ earlier[1].poses)
    settings = with_overrides(
        known, [f"config.known_map.path={tmp_path / 'moved.ply'}", *near(start, LATER, (-1.0, 1.0, 0.0))]
    )
    run = run_sequence(recording, settings, tmp_path / "out", LATER)
    assert errors(run.trajectory, start).max() < 0.03


def test_without_inertial_samples(tmp_path, recording, known, earlier):
    settings = with_overrides(known, ["config.imu.use=false", *near(earlier[1], LATER)])
    run = run_sequence(recording, settings, tmp_path, LATER)
    assert errors(run.trajectory, earlier[1]).max() < 0.06


def test_a_killed_run_goes_on_with_the_same_parts_of_the_map(tmp_path, recording, known, monkeypatch):
    # small parts within a short reach: they come on the way
    monkeypatch.setattr(known_map, "_TILE", 0.5)
    monkeypatch.setattr(known_map, "_MOVED", 0.3)
    settings = with_overrides(known, ["params.map.reach=16"])
    handed = []
    program = MapPager.paged

    def counted(pager, state):
        handed.append(pager._next is not None)
        return program(pager, state)

    monkeypatch.setattr(MapPager, "paged", counted)
    folders, whole = killed_at(recording, settings, tmp_path, (4, 26))
    assert sum(handed) > 3
    for folder in folders:
        resumable(recording, settings, folder)
        assert contents(folder) == whole


def test_an_imu_that_is_mounted_askew_finds_its_attitude(recording, resolved, earlier):
    """The same drive, as an IMU records it that is tilted by a quarter of a radian."""
    R = Rotation.from_euler("xyz", [0.2, -0.15, 0.6]).as_matrix()
    askew = np.eye(4)
    askew[:3, :3] = R
    samples = recording.imu()
    samples = replace(samples, gyro=samples.gyro @ R, accel=samples.accel @ R)
    T_imu_lidar = np.linalg.inv(askew) @ inertial_drive.drive().info.T_imu_lidar
    settings = with_overrides(resolved, near(earlier[1], LATER, (1.0, -1.0, 0.0)))
    # the heading of the tilted axes
    expected = earlier[1].poses[LATER] @ askew
    heading = np.arctan2(expected[1, 0], expected[0, 0])
    settings = with_extrinsics(
        with_overrides(settings, [f"params.known_map.heading={heading:.3f}"]), T_imu_lidar, "the test"
    )
    start = localise(recording, KnownMap.read(earlier[0]), settings, samples, first=LATER)
    off = np.linalg.inv(expected) @ start.T_world_imu
    assert np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec()) < 0.03
    assert np.linalg.norm(off[:3, 3]) < 0.5


def test_places_and_ways_that_do_not_fit_are_named(tmp_path, recording, known, resolved, earlier):
    def fails(error, words, *extra):
        with pytest.raises(error, match=words):
            run_sequence(recording, with_overrides(known, list(extra)), tmp_path / "out")

    fails(LioJaxError, "does not fit the known map near", "params.known_map.position=[400, 0, 0]")
    fails(LioJaxError, r"gone: no such map|gone.*give the folder", f"config.known_map.path={tmp_path}/gone")
    empty = tmp_path / "empty.pcd"
    write_cloud(empty, [], 0)
    fails(LioJaxError, "empty.pcd: holds no possible points", f"config.known_map.path={empty}")
    torn = tmp_path / "torn.ply"
    torn.write_bytes(b"ply\nformat")
    fails(LioJaxError, "torn.ply: damaged or cut short", f"config.known_map.path={torn}")
    fails(
        LioJaxError,
        "trajectory.tum: no such file",
        f"config.known_map.path={earlier[0] / 'map.pcd'}",
        "config.known_map.search=true",
    )
    loam = with_overrides(recipe_settings("loam"), [f"config.known_map.path={earlier[0]}"])
    with pytest.raises(UsageError, match="the recipe loam cannot begin in a known map"):
        step_of(recording, loam, recording.imu())
    with pytest.raises(UsageError, match="has no effect on gradients and tuning"):
        gradient(recording, ["imu.gyro_noise"], settings=known)
    with pytest.raises(UsageError, match="has no effect on pushed data"):
        PushedOdometry(known)


def test_a_street_of_equal_houses_is_ambiguous(resolved, recording):
    """Two copies of the map: the scan fits both."""
    # the map of the scan itself, twice
    scan = inertial_drive.scan(inertial_drive.START)
    points = scan.points.astype(np.float64)
    points = points[np.linalg.norm(points, axis=1) < 40]
    twice = KnownMap(np.concatenate([points, points + np.array([7.0, 0.0, 0.0])]))
    settings = with_overrides(resolved, ["params.known_map.position_error=12"])
    with pytest.raises(LioJaxError, match=r"fits the known map at .* and at .*; give the start"):
        localise(recording, twice, settings, recording.imu())


def test_the_pager_hands_over_each_tile_once_and_again_after_it_was_left(monkeypatch):
    """Against a count of the points near the vehicle."""
    rng = np.random.default_rng(0)
    x = np.linspace(0, 400, 40001)
    points = np.stack([x, rng.uniform(-5, 5, len(x)), rng.uniform(0, 3, len(x))], -1)
    ways = np.arange(0, 300, 2.0), np.arange(300, 0, -2.0)
    handed = [[]]

    def counted(params, state, points, mask, origin):
        handed[-1].append(points[mask] + origin)
        return state

    settings = with_overrides(recipe_settings("default"), ["params.map.reach=40"])
    pager = MapPager(KnownMap(points), recipe_of(settings), settings.params(), np.zeros(3))
    monkeypatch.setattr(pager, "_program", counted)
    pager.filled(None)
    for back, way in enumerate(ways):
        handed += [[]] * back
        for position in way:
            pager.moved_to(np.array([position, 0.0, 0.0]))
            pager.paged(None)
            # the way back begins among tiles that are still held
            if back and position > 200:
                continue
            held = np.concatenate(handed[-1])[:, 0]
            ahead = held[np.abs(held - position) < 10]
            expected = min(position + 10, 400) - max(position - 10, 0)
            assert len(np.unique(ahead.round(3))) >= 1900 * expected / 20
    # no tile comes twice on one way
    for parts in handed:
        together = np.concatenate(parts)
        assert len(np.unique(together, axis=0)) == len(together)


def test_a_start_in_a_map_keeps_the_errors_in_the_body_s_axes(recording, resolved):
    """The first step in a turned world gives the turned state and the same covariance of the body's error."""
    recipe = recipe_of(resolved)
    assert isinstance(recipe, LocalisingRecipe)
    params = resolved.params()
    still = _first_state(resolved, recording)
    before = eqx.tree_at(lambda state: state.nav.velocity, still, jnp.array([3.0, -1.0, 0.2]))
    turned = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_z_radians(1.1), jnp.array([30.0, -4.0, 2.0])
    )
    T = before.nav.T_world_imu
    here, there = recipe.placed(params, before, T), recipe.placed(params, before, turned @ T)
    np.testing.assert_allclose(there.covariance[:15, :15], here.covariance[:15, :15], atol=1e-12)
    np.testing.assert_allclose(there.nav.velocity, turned.rotation() @ here.nav.velocity, atol=1e-12)
    # seen from the body, the direction of gravity has the same errors, correlated with the same others
    body = [
        np.asarray(rotation_matrix(one.nav.T_world_imu.rotation()).T @ sphere_basis(one.nav.gravity))
        for one in (here, there)
    ]
    others = np.r_[0:15, 17:24]
    for turn, one in zip(body, (here, there), strict=True):
        fall = turn @ np.asarray(one.covariance)[15:17]
        found = np.concatenate([fall[:, others], fall[:, 15:17] @ turn.T], axis=1)
        expected = found if one is here else expected
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.abs(expected).max() > 1e-7
    assert np.all(np.diag(here.covariance)[:6] > np.diag(before.covariance)[:6])


def _first_state(settings, recording):
    samples = feed_of(recording.imu(), settings).before(inertial_drive.scan(LATER))
    return CompiledStep(settings).init(samples)


def test_map_points_fill_the_voxels_of_the_recipe_s_map(recording, resolved):
    """What the map holds afterwards is what its points say, far from the origin, too."""
    recipe, params = recipe_of(resolved), resolved.params()
    state = _first_state(resolved, recording)
    rng = np.random.default_rng(1)
    origin = np.array([5000.0, -3000.0, 120.0])
    points = rng.uniform(-20, 20, (3000, 3)).astype(np.float32)
    filled = recipe.with_map_points(
        params, state, jnp.asarray(points), jnp.arange(3000) < 2000, jnp.asarray(origin)
    )
    size = float(params.map.voxel_size)
    wanted = {tuple(row) for row in np.floor((points[:2000] + origin) / size).astype(int)}
    voxel = np.asarray(filled.map.voxel)
    held = {tuple(row) for row in voxel[voxel[:, 0] != FREE]}
    assert held <= wanted
    # a voxel has two slots, and both may be taken
    assert len(held) > 0.995 * len(wanted)
