"""The simulated sequence: true motion distortion, exact truth, repeatable bytes."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory, pose_matrices
from lio_jax.sim.gps import GpsModel
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.lidar import ranging, spinning_lidar
from lio_jax.sim.sensors import SENSORS
from lio_jax.sim.sequence import EPOCH_NS, WORLDS, SimulatedSequence
from lio_jax.sim.worlds import nearest_part
from tests.sim.surfaces import surface_distance

BEAMS, COLUMNS = 16, 512
TURNING = 85
"""A scan in the street's first turn, at about 4 m/s and 0.4 rad/s."""


@cache
def street(seed: int = 3) -> SimulatedSequence:
    return SimulatedSequence("street", duration_s=10.0, seed=seed, beams=BEAMS, columns=COLUMNS)


@pytest.fixture(scope="module")
def drive():
    return street()


@pytest.fixture(scope="module")
def turning(drive):
    return next(drive.scans(TURNING, 1))


def _in_world(sequence, scan, times):
    poses = sequence.poses((scan.stamp_ns - EPOCH_NS) * 1e-9 + times) @ sequence.info.T_imu_lidar
    return np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points.astype(np.float64)) + poses[:, :3, 3]


def _moving(world, start, times):
    """Return where the moving boxes are ``times`` s after a sweep's start, for surface_distance."""
    movers = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), world.movers)
    steps = movers.yaw.shape[1]
    centers, yaws = [], []
    for body, offset, turned in zip(
        movers.body.astype(int), movers.boxes.center, movers.boxes.yaw, strict=True
    ):
        path, heading, period = movers.path[body], movers.yaw[body], movers.period[body]
        passed = start / period % 1 * steps
        now, share = int(passed) % steps, passed - int(passed)
        ahead = path[(now + 1) % steps] - path[now]
        turn = np.angle(np.exp(1j * (heading[(now + 1) % steps] - heading[now])))
        yaw = heading[now] + share * turn
        rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        base = path[now] + share * ahead + rotation @ offset
        centers.append(base + np.outer(times, ahead * steps / period))
        yaws.append(yaw + turned)
    return np.array(centers), movers.boxes.half_size, np.array(yaws)


def test_is_a_sequence(drive):
    reader: Sequence = drive
    assert reader.info.scan_count == 100
    assert reader.imu() is None
    assert reader.gps() is None
    assert reader.warnings_so_far == ()
    assert not np.allclose(reader.info.T_imu_lidar[:3, :3], np.eye(3))
    assert drive.lidar_layout == "velodyne"
    assert drive.duration_s == pytest.approx(10.0)


@pytest.mark.parametrize("world", sorted(WORLDS))
def test_points_put_back_at_their_own_time_lie_on_surfaces(world):
    exact = eqx.tree_at(lambda lidar: lidar.ranging, spinning_lidar(BEAMS, 256), ranging(0.0))
    sequence = SimulatedSequence(world, exact, 9.0, seed=3, standstill_s=0.0)
    scan = next(sequence.scans(80, 1))
    assert len(scan.points) > 500
    times = scan.time.astype(np.float64)
    moving = _moving(sequence.world, (scan.stamp_ns - EPOCH_NS) * 1e-9, times)
    gap = surface_distance(sequence.world, _in_world(sequence, scan, times), moving)
    assert gap.max() < 1e-5
    # the same points at the wrong time do not: the distortion is real
    frozen = _in_world(sequence, scan, 0 * times)
    assert surface_distance(sequence.world, frozen, moving).max() > 0.01


def test_with_noise_points_lie_off_surfaces_by_no_more_than_the_noise(drive, turning):
    gap = surface_distance(drive.world, _in_world(drive, turning, turning.time.astype(np.float64)))
    # range noise moves a point by sigma along its ray, hence at most by that off the surface
    sigma = float(drive.lidar.ranging.sigma)
    assert gap.max() < 5 * sigma
    assert 0.2 * sigma < np.sqrt(np.mean(gap**2)) < sigma


def test_same_seed_same_bytes_in_any_order(drive, turning):
    again = SimulatedSequence("street", duration_s=10.0, seed=3, beams=BEAMS, columns=COLUMNS)
    first, second = again.scans(TURNING - 1, 2)
    assert first.stamp_ns == turning.stamp_ns - 100_000_000
    for name in ("points", "time", "ring", "intensity"):
        assert getattr(second, name).tobytes() == getattr(turning, name).tobytes()


def test_other_seed_other_world(turning):
    other = next(street(4).scans(TURNING, 1))
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
    assert np.abs(wrapped).max() < 1e-6
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
    np.testing.assert_allclose(truth.positions[0], 0, atol=0.05)
    assert truth.stamp_ns[0] == EPOCH_NS
    assert turning.end_ns in truth.stamp_ns
    assert truth.stamp_ns[-1] == EPOCH_NS + 10_000_000_000
    exact = drive.poses(np.array([7.654321]))
    interpolated = truth.at(EPOCH_NS + np.array([7_654_321_000])).poses
    np.testing.assert_allclose(interpolated, exact, atol=2e-4)


def test_poses_do_not_depend_on_how_many_are_asked_for(drive):
    many = drive.poses(np.linspace(0, 9, 5000))
    np.testing.assert_array_equal(many[[0, 4999]], drive.poses(np.array([0.0, 9.0])))
    assert drive.poses(np.empty(0)).shape == (0, 4, 4)


def test_imu_gps_and_their_truth_come_with_the_recording(drive):
    model = ImuModel(rate=100.0, time_offset=0.01)
    sequence = SimulatedSequence(
        "street", duration_s=10.0, seed=3, beams=BEAMS, columns=COLUMNS, imu=model, gps=GpsModel()
    )
    imu, gps = sequence.imu(), sequence.gps()
    assert imu.stamp_ns[0] == EPOCH_NS + 10_000_000  # late by the clock's offset
    assert len(imu.stamp_ns) == 1001
    assert np.linalg.norm(imu.accel[:50].mean(axis=0)) == pytest.approx(9.80665, abs=0.2)
    assert gps.stamp_ns[0] == EPOCH_NS
    known = sequence.truth_arrays()
    assert known["gyro_bias"].shape == (1001, 3)
    assert known["gyro_noise"] == model.gyro_noise
    assert known["time_offset"] == 0.01
    np.testing.assert_array_equal(known["T_imu_lidar"], sequence.info.T_imu_lidar)
    assert known["range_sigma"] == pytest.approx(0.02)
    # scans do not change because other sensors ride along
    assert next(sequence.scans(TURNING, 1)).points.tobytes() == next(drive.scans(TURNING, 1)).points.tobytes()


def test_truth_arrays_without_an_imu(drive):
    assert set(drive.truth_arrays()) == {"T_imu_lidar", "range_sigma", "gravity"}


def test_an_extrinsic_of_ones_own_is_honoured():
    extrinsic = np.eye(4)
    extrinsic[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    extrinsic[:3, 3] = [0.3, -0.1, 0.2]
    exact = eqx.tree_at(lambda lidar: lidar.ranging, spinning_lidar(BEAMS, 256), ranging(0.0))
    sequence = SimulatedSequence("room", exact, 6.0, T_imu_lidar=extrinsic)
    np.testing.assert_allclose(sequence.info.T_imu_lidar, extrinsic)
    scan = next(sequence.scans(50, 1))
    gap = surface_distance(sequence.world, _in_world(sequence, scan, scan.time.astype(np.float64)))
    assert gap.max() < 1e-5


def test_standing_and_moving_starts():
    lidar = spinning_lidar(1, 8)
    times = np.array([0.0, 0.1])
    for words, low, high in (
        ({"standstill_s": 1.0}, 0.0, 1e-9),
        ({"moving_start": True}, 0.3, 0.9),
        ({}, 0.0, 1e-9),
    ):
        moved = np.diff(SimulatedSequence("street", lidar, 1.0, **words).poses(times)[:, :3, 3], axis=0)
        assert low <= np.linalg.norm(moved) <= high


def test_nothing_in_range_is_left_out_anywhere_on_a_long_drive():
    long = SimulatedSequence("street", spinning_lidar(1, 8), 150.0)
    positions = jnp.asarray(long.poses(np.arange(0, 150, 0.37))[:, :3, 3])
    reach = jax.jit(
        jax.vmap(lambda position: nearest_part(long.world, position, jnp.zeros(()), long._counts)[1])
    )(positions)
    assert float(reach.min()) > float(long.lidar.ranging.maximum)


def test_results_do_not_depend_on_the_x64_flag(turning):
    with jax.enable_x64(False):
        single = next(
            SimulatedSequence("street", duration_s=10.0, seed=3, beams=BEAMS, columns=COLUMNS).scans(
                TURNING, 1
            )
        )
    np.testing.assert_array_equal(single.points, turning.points)


def test_sensors_by_name_and_as_objects():
    sequence = SimulatedSequence("room", "os1_64", 1.0)
    assert sequence.lidar_layout == "ouster"
    assert "Ouster OS1-64" in sequence.info.sensor
    assert SimulatedSequence("room", SENSORS["livox"].build(), 1.0).lidar_layout == "livox"


def test_livox_sweeps_see_different_points():
    first, second = SimulatedSequence("room", "livox", 1.0).scans(0, 2)
    assert len(first.points) > 20_000
    assert np.all(np.diff(first.time) >= 0)
    assert np.abs(first.points[:1000] - second.points[:1000]).max() > 0.1


def test_unknown_world_names_those_that_exist():
    with pytest.raises(UsageError, match=r"'tunel' is unknown; choose one of: .*room.*street"):
        SimulatedSequence("tunel")


def test_unknown_sensor_names_those_that_exist():
    with pytest.raises(UsageError, match=r"'vlp61' is unknown; choose one of: .*vlp16"):
        SimulatedSequence("room", "vlp61")


@pytest.mark.parametrize("duration", [0.0, 0.05, -1.0, float("nan"), float("inf")])
def test_too_short_a_recording_is_refused(duration):
    with pytest.raises(UsageError, match=r"holds no scan; give at least 0\.1 s"):
        SimulatedSequence("room", duration_s=duration)


def test_beams_of_a_real_sensor_cannot_be_chosen():
    with pytest.raises(UsageError, match="vlp16: beams and columns can be set for generic32 only"):
        SimulatedSequence("room", "vlp16", beams=32)


def test_an_extrinsic_that_is_no_rigid_transform_is_refused():
    with pytest.raises(UsageError, match="T_imu_lidar is not a rigid transform"):
        SimulatedSequence("room", T_imu_lidar=np.diag([1.0, 1.0, 2.0, 1.0]))


def _standing(seconds):
    count = round(10 * seconds) + 1
    rotations = np.tile([0.0, 0, 0, 1], (count, 1))
    return Trajectory(np.arange(count) * 100_000_000, pose_matrices(np.zeros((count, 3)), rotations))


def test_a_trajectory_that_ends_too_soon_is_refused():
    with pytest.raises(UsageError, match=r"the trajectory ends after 2\.00 s, before the wanted 3\.0 s"):
        SimulatedSequence("room", duration_s=3.0, trajectory=_standing(2.0))


@pytest.mark.parametrize("words", [{"moving_start": True}, {"standstill_s": 2.0}, {"swing_rate": 4.0}])
def test_a_trajectory_leaves_no_choice_of_the_start(words):
    with pytest.raises(UsageError, match="a trajectory itself says how it moves"):
        SimulatedSequence("room", trajectory=_standing(2.0), **words)


def test_a_hand_looks_around_as_fast_as_is_asked_for():
    def turning(**words):
        return np.abs(SimulatedSequence("office", duration_s=6.0, imu=ImuModel(), **words).imu().gyro).max()

    assert turning(swing_rate=4.0) > 2 * turning()
    with pytest.raises(UsageError, match="nobody carries the sensor"):
        SimulatedSequence("street", swing_rate=4.0)
