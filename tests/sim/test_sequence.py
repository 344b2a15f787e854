"""The simulated sequence: true motion distortion, exact truth, repeatable bytes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import Sequence
from lio_jax.sim import sequence as module
from lio_jax.sim.sequence import EPOCH_NS, SimulatedSequence
from lio_jax.sim.worlds import nearest_part

BEAMS, COLUMNS = 16, 512
TURNING = 85
"""A scan in the first turn, at about 4 m/s and 0.4 rad/s."""


@pytest.fixture(scope="module")
def drive():
    return SimulatedSequence(beams=BEAMS, columns=COLUMNS, duration_s=10.0, seed=3)


@pytest.fixture(scope="module")
def turning(drive):
    return next(drive.scans(TURNING, 1))


def _signed_distance(drive, points):
    """Signed distance of world points to the union of all shapes, brute force in float64."""
    world = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), drive.world)
    nearest = points[:, 2] - world.planes.point[0, 2]
    for center, half, yaw in zip(world.boxes.center, world.boxes.half_size, world.boxes.yaw, strict=True):
        x, y, z = (points - center).T
        local = np.abs([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, z]).T
        gap = local - half
        nearest = np.minimum(nearest, np.linalg.norm(np.maximum(gap, 0), axis=1) + np.minimum(gap.max(1), 0))
    cylinders = world.cylinders
    for base, radius, height in zip(cylinders.base, cylinders.radius, cylinders.height, strict=True):
        x, y, z = (points - base).T
        gap = np.stack([np.hypot(x, y) - radius, np.abs(z - height / 2) - height / 2], axis=1)
        nearest = np.minimum(nearest, np.linalg.norm(np.maximum(gap, 0), axis=1) + np.minimum(gap.max(1), 0))
    return nearest


def _in_world(drive, scan, times):
    poses = drive.poses((scan.stamp_ns - EPOCH_NS) * 1e-9 + times) @ drive.info.T_imu_lidar
    return np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points.astype(np.float64)) + poses[:, :3, 3]


def test_is_a_sequence(drive):
    reader: Sequence = drive
    assert reader.info.scan_count == 100
    assert reader.imu() is None
    assert reader.gps() is None
    assert reader.warnings_so_far == ()
    assert not np.allclose(reader.info.T_imu_lidar[:3, :3], np.eye(3))


def test_points_lie_on_surfaces_when_put_back_at_their_own_time(drive, turning):
    gap = _signed_distance(drive, _in_world(drive, turning, turning.time.astype(np.float64)))
    # range noise moves a point by sigma along its ray, hence at most by that off the surface
    sigma = float(drive.lidar.range_sigma)
    assert np.abs(gap).max() < 5 * sigma
    assert 0.2 * sigma < np.sqrt(np.mean(gap**2)) < sigma
    # the same points at the wrong time do not: the distortion is real
    frozen = _signed_distance(drive, _in_world(drive, turning, np.zeros(len(turning.time))))
    assert np.sqrt(np.mean(frozen**2)) > 3 * sigma


def test_without_noise_points_lie_exactly_on_surfaces(turning):
    silent = SimulatedSequence(beams=BEAMS, columns=COLUMNS, duration_s=10.0, seed=3)
    silent.lidar = type(silent.lidar)(
        silent.lidar.elevation, COLUMNS, 0.1, jnp.float32(0), silent.lidar.min_range, silent.lidar.max_range
    )
    scan = next(silent.scans(TURNING, 1))
    assert len(scan.points) == len(turning.points)
    gap = _signed_distance(silent, _in_world(silent, scan, scan.time.astype(np.float64)))
    assert np.abs(gap).max() < 3e-4  # float32 at 100 m


def test_same_seed_same_bytes_in_any_order(drive, turning):
    again = SimulatedSequence(beams=BEAMS, columns=COLUMNS, duration_s=10.0, seed=3)
    first, second = again.scans(TURNING - 1, 2)
    assert first.stamp_ns == turning.stamp_ns - 100_000_000
    for name in ("points", "time", "ring", "intensity"):
        assert getattr(second, name).tobytes() == getattr(turning, name).tobytes()


def test_other_seed_other_world(turning):
    other = next(SimulatedSequence(beams=BEAMS, columns=COLUMNS, duration_s=10.0, seed=4).scans(TURNING, 1))
    assert other.points.tobytes() != turning.points.tobytes()


def test_scan_noise_differs_between_scans_at_rest(drive):
    first, second = drive.scans(0, 2)
    assert first.points.tobytes() != second.points.tobytes()
    assert len(first.points) == pytest.approx(len(second.points), abs=20)


def test_fields_follow_the_firing_order(turning):
    assert np.all(np.diff(turning.time) >= 0)
    assert turning.time.min() >= 0
    assert turning.time.max() < turning.duration == 0.1
    azimuth = np.arctan2(turning.points[:, 1], turning.points[:, 0])
    expected = np.pi - 2 * np.pi * turning.time / turning.duration  # clockwise from behind
    wrapped = np.angle(np.exp(1j * (azimuth - expected)))
    assert np.abs(wrapped).max() < 1e-4
    elevation = np.rad2deg(np.arcsin(turning.points[:, 2] / np.linalg.norm(turning.points, axis=1)))
    np.testing.assert_allclose(elevation, -25 + turning.ring * 40 / (BEAMS - 1), atol=1e-3)
    assert turning.points.dtype == turning.time.dtype == turning.intensity.dtype == np.float32
    assert turning.ring.dtype == np.int32
    assert 0 <= turning.intensity.min() < turning.intensity.max() <= 255


def test_ranges_stay_within_limits_and_most_beams_return(drive, turning):
    ranges = np.linalg.norm(turning.points, axis=1)
    assert ranges.max() < 100 + 0.15
    assert ranges.min() > 0.5 - 0.15
    assert len(ranges) > 0.8 * BEAMS * COLUMNS


def test_truth_starts_at_the_origin_and_holds_every_scan_end(drive, turning):
    truth = drive.truth()
    np.testing.assert_allclose(truth.poses[0], np.eye(4), atol=1e-9)
    assert truth.stamp_ns[0] == EPOCH_NS
    assert turning.end_ns in truth.stamp_ns
    assert truth.stamp_ns[-1] == list(drive.scans(99, 5))[-1].end_ns
    exact = drive.poses(np.array([7.654321]))
    interpolated = truth.at(EPOCH_NS + np.array([7_654_321_000])).poses
    np.testing.assert_allclose(interpolated, exact, atol=1e-4)


def test_the_lidar_pose_is_the_imu_pose_times_the_extrinsic(drive, turning):
    with jax.enable_x64(True):
        columns, center = module._column_poses(
            drive.drive, drive._T_imu_lidar, jnp.float64(TURNING * 0.1), drive.lidar
        )
    expected = (drive.poses(np.array([TURNING * 0.1])) @ drive.info.T_imu_lidar)[0]
    np.testing.assert_allclose(center, expected[:3, 3], atol=1e-5)
    np.testing.assert_allclose(columns.as_matrix()[0, :3, :3], expected[:3, :3], atol=1e-6)


def test_nothing_in_range_is_left_out_anywhere_on_a_long_drive():
    long = SimulatedSequence(beams=1, columns=8, duration_s=200.0, seed=0)
    positions = jnp.asarray(long.poses(np.arange(0, 200, 0.37))[:, :3, 3], jnp.float32)
    reach = jax.jit(jax.vmap(lambda position: nearest_part(long.world, position, *long._part_counts)[1]))(
        positions
    )
    assert float(reach.min()) > float(long.lidar.max_range)


def test_the_car_keeps_clear_of_everything():
    for seed in range(3):
        drive = SimulatedSequence(beams=1, columns=8, duration_s=100.0, seed=seed)
        path = drive.poses(np.arange(0, 100, 0.1))[:, :3, 3]
        drive.world = type(drive.world)(
            jax.tree.map(lambda leaf: leaf - 100.0, drive.world.planes),
            drive.world.boxes,
            drive.world.cylinders,
        )
        at_half_height = path - [0, 0, 0.9]
        assert _signed_distance(drive, at_half_height).min() > 1.2


def test_results_do_not_depend_on_the_x64_flag(turning):
    with jax.enable_x64(False):
        single = next(
            SimulatedSequence(beams=BEAMS, columns=COLUMNS, duration_s=10.0, seed=3).scans(TURNING, 1)
        )
    np.testing.assert_array_equal(single.points, turning.points)


def test_unknown_world_names_those_that_exist():
    with pytest.raises(UsageError, match="'tunnel' is unknown; choose one of: street"):
        SimulatedSequence(world="tunnel")


def test_too_short_a_drive_is_refused():
    with pytest.raises(UsageError, match=r"0\.05 s holds no scan"):
        SimulatedSequence(duration_s=0.05)
