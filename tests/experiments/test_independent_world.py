"""The world of meshes and splines: its geometry, its inertial samples, its noise, and a run on it."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("trimesh", reason="trimesh is not installed: pip install 'lio-jax[dev]'")
pytest.importorskip("embreex", reason="embreex is not installed: pip install 'lio-jax[dev]'")

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
if str(EXPERIMENTS) not in sys.path:
    sys.path.append(str(EXPERIMENTS))

import trimesh  # noqa: E402
from independent.motion import GRAVITY, motion_of  # noqa: E402
from independent.recording import T_IMU_LIDAR, Recording  # noqa: E402
from independent.sensors import Imu, Lidar, RayCaster, samples_of, scan_at  # noqa: E402
from independent.street import CentreLine, Ground, street  # noqa: E402

from lio_jax import evaluate, recipe_settings, run_sequence, settings_for, with_overrides  # noqa: E402
from lio_jax.data.detect import open_sequence  # noqa: E402


class Uniform:
    """A motion with constant velocity and constant angular rate."""

    velocity = np.array([2.0, -1.0, 0.5])
    rate = np.array([0.1, -0.2, 0.8])

    def poses(self, times):
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(np.asarray(times)[:, None] * self.rate).as_matrix()
        poses[:, :3, 3] = np.asarray(times)[:, None] * self.velocity
        return poses


def room() -> trimesh.Trimesh:
    """Return a box around the origin with walls at x = 7, y = 5, z = 4 and opposite of them."""
    return trimesh.creation.box([14.0, 10.0, 8.0])


def motion(kind="vehicle", start="rest", seconds=6.0):
    line, ground = CentreLine(), Ground.drawn(np.random.default_rng(0))
    return motion_of(kind, start, seconds, 0, line, ground)


def test_ranges_in_a_box_are_the_analytic_ones():
    rng = np.random.default_rng(0)
    origins = rng.uniform(-1, 1, (500, 3)) * [5, 4, 3]
    rays = rng.normal(size=(500, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    walls = np.sign(rays) * [7.0, 5.0, 4.0]
    expected = ((walls - origins) / rays).min(axis=1)
    assert np.allclose(RayCaster(room()).ranges(origins, rays), expected, rtol=0, atol=1e-9)


def test_a_ray_into_the_sky_has_no_range():
    line, ground = CentreLine(), Ground.drawn(np.random.default_rng(3))
    caster = RayCaster(street(3, line, ground))
    point = line.point(np.array([20.0]))
    origin = np.column_stack([point, ground.height(point) + 1.0])
    assert np.isinf(caster.ranges(origin, np.array([[0.0, 0.0, 1.0]]))).all()
    # the facets of the ground lie below and above the waves by less than this
    assert caster.ranges(origin, np.array([[0.0, 0.0, -1.0]])) == pytest.approx(1.0, abs=0.02)


def test_each_column_is_cast_from_the_pose_at_its_own_time():
    lidar = Lidar(16, 256, range_sigma=0.0, dropouts=0.0)
    turn = scan_at(0.3, lidar, T_IMU_LIDAR, Uniform(), RayCaster(room()), np.random.default_rng(0))
    poses = Uniform().poses(0.3 + turn.time) @ T_IMU_LIDAR
    placed = np.einsum("nij,nj->ni", poses[:, :3, :3], turn.points) + poses[:, :3, 3]
    assert len(placed) == 16 * 256
    assert np.abs(np.abs(placed / [7.0, 5.0, 4.0]).max(axis=1) - 1).max() < 1e-9
    frozen = Uniform().poses(np.full(len(turn.time), 0.3)) @ T_IMU_LIDAR
    smeared = np.einsum("nij,nj->ni", frozen[:, :3, :3], turn.points) + frozen[:, :3, 3]
    assert np.abs(np.abs(smeared / [7.0, 5.0, 4.0]).max(axis=1) - 1).max() > 0.01


def test_noise_and_dropouts_of_the_ranges_are_as_stated():
    lidar = Lidar(32, 1024, range_sigma=0.03, dropouts=0.1)
    turn = scan_at(0.0, lidar, T_IMU_LIDAR, Uniform(), RayCaster(room()), np.random.default_rng(1))
    true = scan_at(
        0.0, Lidar(32, 1024, range_sigma=0.0, dropouts=0.0), T_IMU_LIDAR, Uniform(), RayCaster(room()),
        np.random.default_rng(1),
    )  # fmt: skip
    count = len(turn.points)
    assert count / len(true.points) == pytest.approx(0.9, abs=0.01)
    assert turn.noise.std() == pytest.approx(0.03, rel=4 / np.sqrt(2 * count))
    poses = Uniform().poses(turn.time) @ T_IMU_LIDAR
    placed = np.einsum("nij,nj->ni", poses[:, :3, :3], turn.points) + poses[:, :3, 3]
    assert np.abs(np.abs(placed / [7.0, 5.0, 4.0]).max(axis=1) - 1).max() > 0.005


@pytest.mark.parametrize(("kind", "start"), [("vehicle", "rest"), ("handheld", "moving")])
def test_ideal_samples_integrate_to_the_trajectory(kind, start):
    seconds, rate = 6.0, 2000.0
    moves = motion(kind, start, seconds)
    ideal = samples_of(moves, Imu(rate, 0, 0, 0, 0, 0, 0), seconds, np.random.default_rng(0))
    first = moves.poses(np.zeros(1))[0]
    turned, position, velocity = Rotation.from_matrix(first[:3, :3]), first[:3, 3], moves.position(0.0, 1)
    for k in range(len(ideal.time) - 1):
        # trapezoids: their error over 6 s is far below a millimetre
        after = turned * Rotation.from_rotvec(0.5 * (ideal.gyro[k] + ideal.gyro[k + 1]) / rate)
        both = turned.apply(ideal.accel[k]) + after.apply(ideal.accel[k + 1])
        change = (0.5 * both + GRAVITY) / rate
        position = position + (velocity + 0.5 * change) / rate
        turned, velocity = after, velocity + change
    last = moves.poses(np.array([seconds]))[0]
    assert np.linalg.norm(position - last[:3, 3]) < 1e-3
    assert (Rotation.from_matrix(last[:3, :3]).inv() * turned).magnitude() < 1e-4


def test_a_start_at_rest_is_at_rest_and_a_moving_start_moves():
    times = np.arange(0, 1.4, 0.01)
    for kind in ("vehicle", "handheld"):
        rest, moving = motion(kind, "rest"), motion(kind, "moving")
        assert np.abs(rest.position(times, 1)).max() < 1e-3
        assert np.abs(rest.angular_rate(times)).max() < 1e-4
        assert np.linalg.norm(moving.position(0.0, 1)) > 1.0


def test_the_noise_of_the_samples_is_as_stated():
    seconds, imu = 60.0, Imu(100.0, 2e-3, 3e-2, 1e-4, 1e-3)
    moves = motion(seconds=seconds)
    found = samples_of(moves, imu, seconds, np.random.default_rng(2))
    count = 3 * len(found.time)
    for measured, true, bias, density in (
        (found.gyro, moves.angular_rate(found.time), found.gyro_bias, imu.gyro_noise),
        (found.accel, moves.specific_force(found.time), found.accel_bias, imu.accel_noise),
    ):
        noise = measured - true - bias
        assert noise.std() / np.sqrt(imu.rate_hz) == pytest.approx(density, rel=4 / np.sqrt(2 * count))
    steps = np.diff(found.gyro_bias, axis=0)
    assert steps.std() * np.sqrt(imu.rate_hz) == pytest.approx(1e-4, rel=4 / np.sqrt(2 * count))


def test_the_default_recipe_follows_five_seconds(tmp_path):
    scans = Recording(seed=2, seconds=5.0, lidar=Lidar(16)).write(tmp_path / "street")
    sequence = open_sequence(tmp_path / "street")
    assert scans == sequence.info.scan_count == 50
    small = ["config.output.map=false"]
    settings, _ = settings_for(sequence, with_overrides(recipe_settings("default"), small))
    run = run_sequence(sequence, settings, tmp_path / "run")
    errors = evaluate(run.trajectory, sequence.truth())
    # 10 m of the way; the ranges are known to 0.02 m
    assert errors.path_length_m > 5
    assert errors.ate.rmse < 0.01
    assert run.metrics["verdict"]["state"] == "sound"
