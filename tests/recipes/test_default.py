"""The default recipe on a drive whose every pose is known, and on the scans that recordings really hold."""

import dataclasses
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.types import CONVERGED, LOST, Scan
from lio_jax.recipes.default import Default
from tests.recipes.drive import (
    CONFIG,
    PARAMS,
    PERIOD,
    STEP,
    TWIST,
    Step,
    apart,
    distance_to_hall,
    expected_pose,
    initial,
    lidar_pose,
    moved,
    params_with,
    run,
    scan,
)

SCANS = 11


def changed(item: Scan, **fields) -> Scan:
    """Return the scan with fields replaced, each in its own dtype."""
    return dataclasses.replace(
        item, **{name: jnp.asarray(value, getattr(item, name).dtype) for name, value in fields.items()}
    )


def empty(item: Scan) -> Scan:
    return changed(item, mask=np.zeros(item.mask.shape), points=np.zeros(item.points.shape))


def end_of(number: int) -> float:
    return (number + 1) * PERIOD


def leaves_equal(one, other) -> bool:
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


@pytest.fixture(scope="module")
def drive() -> list[Step]:
    """The undisturbed drive."""
    return run([scan(number) for number in range(SCANS)])


def test_constant_velocity_is_tracked_in_spite_of_motion_distortion(drive):
    for number, step in enumerate(drive[1:], 1):
        metres, degrees = apart(step.T_world_imu, expected_pose(end_of(number)))
        assert metres < 0.06, f"scan {number}"
        assert degrees < 0.5, f"scan {number}"
        assert step.output.registration.status == CONVERGED
        assert not step.output.lost
        assert not step.output.registration.degenerate.any()


def test_steps_between_scans_are_right_once_the_velocity_is_known(drive):
    for before, after in pairwise(drive[3:]):
        metres, degrees = apart(np.linalg.inv(before.T_world_imu) @ after.T_world_imu, moved(TWIST, PERIOD))
        assert metres < 0.02
        assert degrees < 0.15


def test_poses_are_of_the_scan_end_not_of_its_start_or_middle(drive):
    """At 6 m/s half a scan is 0.3 m."""
    for number, step in enumerate(drive[2:], 2):
        off = [apart(step.T_world_imu, expected_pose(end_of(number) - late))[0] for late in (0, 0.05, 0.1)]
        assert off[0] < 0.06
        assert off[1] > 0.2
        assert off[2] > 0.5


def test_velocity_is_that_of_the_imu_in_world(drive):
    truth = expected_pose(end_of(SCANS - 1))[:3, :3] @ TWIST[:3]
    np.testing.assert_allclose(drive[-1].state.nav.velocity, truth, atol=0.15)


def test_twist_is_the_lidars_own(drive):
    np.testing.assert_allclose(drive[-1].state.twist[:3], TWIST[:3], atol=0.12)
    np.testing.assert_allclose(drive[-1].state.twist[3:], TWIST[3:], atol=0.03)


def test_first_scan_defines_the_world(drive):
    np.testing.assert_allclose(drive[0].T_world_imu, np.eye(4), atol=1e-12)
    assert not drive[0].output.lost
    assert drive[0].state.scans == 1
    assert drive[0].output.added.sum() > 1000


def test_a_restart_with_the_velocity_takes_the_distortion_out_of_the_first_scan(drive):
    """The world's origin is then where the vehicle was at the first scan's end, the map true at once."""
    state, steps = Default(CONFIG).init(PARAMS).with_velocity_of(drive[3].state), []
    assert leaves_equal(state.map, initial().map)
    for number in range(6):
        state, output = STEP(PARAMS, state, scan(number))
        steps.append(Step(state, output))
    start = np.linalg.inv(lidar_pose(end_of(0)))
    np.testing.assert_allclose(steps[0].T_world_imu, np.eye(4), atol=1e-9)
    errors = [
        apart(step.T_world_imu, start @ lidar_pose(end_of(number))) for number, step in enumerate(steps)
    ]
    metres, degrees = np.sqrt(np.mean(np.square(errors), axis=0))
    assert metres < 0.04
    assert degrees < 0.2
    points = np.asarray(steps[0].output.points, float) + np.asarray(steps[0].output.origin)
    T_hall_world = lidar_pose(end_of(0))
    in_hall = points @ T_hall_world[:3, :3].T + T_hall_world[:3, 3]
    assert np.quantile(distance_to_hall(in_hall[np.asarray(steps[0].output.points_mask)]), 0.95) < 0.06


def test_a_standing_sensor_stays():
    twist = np.zeros(6)
    last = run([scan(number, twist=twist) for number in range(8)])[-1]
    metres, degrees = apart(last.T_world_imu, np.eye(4))
    assert metres < 0.015
    assert degrees < 0.05
    assert np.linalg.norm(last.state.nav.velocity) < 0.05


def test_compensated_scans_refer_to_their_stamp():
    """Sweeps of zero duration: the pose is that of the one instant."""
    steps = run([scan(number, still=True) for number in range(8)])
    start = np.linalg.inv(lidar_pose(PERIOD))
    for number, step in enumerate(steps[1:], 1):
        metres, degrees = apart(step.T_world_imu, start @ lidar_pose(end_of(number)))
        assert metres < 0.06
        assert degrees < 0.5


T_IMU_LIDAR = np.eye(4)
T_IMU_LIDAR[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.3, 1.9]).as_matrix()
T_IMU_LIDAR[:3, 3] = [0.8, -0.5, 1.2]


def test_output_is_the_imus_pose_and_velocity_where_the_lidar_is_mounted_askew():
    params = params_with(
        extrinsics__rotation=Rotation.from_matrix(T_IMU_LIDAR[:3, :3]).as_quat().tolist(),
        extrinsics__translation=T_IMU_LIDAR[:3, 3].tolist(),
    )

    def imu_pose(seconds: float) -> np.ndarray:
        return T_IMU_LIDAR @ expected_pose(seconds) @ np.linalg.inv(T_IMU_LIDAR)

    steps = run([scan(number) for number in range(SCANS)], params)
    np.testing.assert_allclose(steps[0].T_world_imu, np.eye(4), atol=1e-12)
    for number, step in enumerate(steps[1:], 1):
        metres, degrees = apart(step.T_world_imu, imu_pose(end_of(number)))
        assert metres < 0.06
        assert degrees < 0.5
        lidar = step.T_world_imu @ T_IMU_LIDAR
        assert apart(lidar, T_IMU_LIDAR @ expected_pose(end_of(number)))[0] < 0.06
    end = end_of(SCANS - 1)
    velocity = (imu_pose(end + 1e-4) - imu_pose(end - 1e-4))[:3, 3] / 2e-4
    np.testing.assert_allclose(steps[-1].state.nav.velocity, velocity, atol=0.15)


def test_output_points_lie_on_the_hall(drive):
    """Points are in the world and motion compensated: without either they would be off by decimetres."""
    T_hall_world = lidar_pose(PERIOD / 2)
    for step in drive[4:]:
        output = step.output
        points = np.asarray(output.points, float)[np.asarray(output.points_mask)] + np.asarray(output.origin)
        off = distance_to_hall(points @ T_hall_world[:3, :3].T + T_hall_world[:3, 3])
        assert len(points) > 1000
        assert np.quantile(off, 0.9) < 0.08
        added = np.asarray(output.added)
        assert not (added & ~np.asarray(output.points_mask)).any()
        assert output.registration.rmse < 0.1


def test_map_grows_only_by_what_is_new(drive):
    added = [int(step.output.added.sum()) for step in drive]
    assert added[0] > 2 * added[-1] > 0


@pytest.mark.parametrize("number", [2, 6])
def test_an_empty_scan_in_the_middle_is_predicted_over(drive, number):
    scans = [scan(k) for k in range(SCANS)]
    scans[number] = empty(scans[number])
    steps = run(scans)
    lost = steps[number]
    assert lost.output.lost
    assert lost.output.registration.status == LOST
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((lost.state, lost.output)))
    predicted = steps[number - 1].T_world_imu @ moved(np.asarray(steps[number - 1].state.twist), PERIOD)
    np.testing.assert_allclose(lost.T_world_imu, predicted, atol=1e-9)
    assert leaves_equal(lost.state.map, steps[number - 1].state.map)
    assert lost.state.scans == steps[number - 1].state.scans
    for k in range(number + 1, SCANS):
        assert steps[k].output.registration.status == CONVERGED
        assert apart(steps[k].T_world_imu, expected_pose(end_of(k)))[0] < 0.08


def test_several_empty_scans_in_a_row(drive):
    scans = [scan(k) for k in range(SCANS)]
    for number in (5, 6, 7):
        scans[number] = empty(scans[number])
    steps = run(scans)
    for number in (5, 6, 7, 8, 9):
        assert bool(steps[number].output.lost) == (number < 8)
        assert apart(steps[number].T_world_imu, expected_pose(end_of(number)))[0] < 0.12


def test_empty_scans_before_the_first_do_not_count():
    late = [scan(number, interval=PERIOD) for number in range(5)]
    steps = run([empty(scan(0)), empty(late[0]), *late])
    plain = run([scan(number) for number in range(5)])
    assert steps[1].state.scans == 0
    assert leaves_equal(steps[1].T_world_imu, np.eye(4))
    for one, other in zip(steps[2:], plain, strict=True):
        np.testing.assert_allclose(one.T_world_imu, other.T_world_imu, atol=1e-6)
        assert not one.output.lost


def spoiled(item: Scan, value: float, rows: np.ndarray) -> Scan:
    points = np.array(item.points)
    points[rows] = value
    return changed(item, points=points, mask=np.asarray(item.mask) | rows)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_ignored(value):
    """A tenth of each scan, its first and last points among them, although the mask calls them real."""
    rng = np.random.default_rng(0)
    scans, without = [], []
    for number in range(6):
        item = scan(number)
        rows = rng.random(len(item.mask)) < 0.1
        rows[:3] = rows[-3:] = True
        scans.append(spoiled(item, value, rows))
        without.append(changed(item, mask=np.asarray(item.mask) & ~rows))
    for one, other in zip(run(scans), run(without), strict=True):
        np.testing.assert_array_equal(one.T_world_imu, other.T_world_imu)
        assert leaves_equal(one.state, other.state)
        mask = np.asarray(one.output.points_mask)
        assert np.isfinite(np.asarray(one.output.points)[mask]).all()
    assert apart(one.T_world_imu, expected_pose(end_of(5)))[0] < 0.06


def test_one_coordinate_that_is_not_finite_spoils_the_point_alone():
    item = scan(1)
    points = np.array(item.points)
    points[::7, 1] = np.nan
    last = run([scan(0), changed(item, points=points), scan(2), scan(3)])[-1]
    assert apart(last.T_world_imu, expected_pose(end_of(3)))[0] < 0.06


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_scan_of_nothing_finite_is_an_empty_scan(value):
    scans = [scan(number) for number in range(7)]
    scans[4] = spoiled(scans[4], value, np.ones(len(scans[4].mask), bool))
    steps = run(scans)
    assert steps[4].output.lost
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(steps[4].state))
    assert not steps[5].output.lost
    assert apart(steps[6].T_world_imu, expected_pose(end_of(6)))[0] < 0.08


@pytest.mark.parametrize("missing", [1, 4])
def test_a_gap_of_missing_scans_is_predicted_over(missing):
    numbers = [0, 1, 2, 3, 4, 5, 6 + missing, 7 + missing, 8 + missing]
    scans = [scan(number) for number in numbers[:6]]
    scans.append(scan(numbers[6], interval=(missing + 1) * PERIOD))
    scans += [scan(number) for number in numbers[7:]]
    for number, step in zip(numbers[1:], run(scans)[1:], strict=True):
        assert step.output.registration.status == CONVERGED
        metres, degrees = apart(step.T_world_imu, expected_pose(end_of(number)))
        assert metres < 0.08, f"scan {number}"
        assert degrees < 0.5, f"scan {number}"
    np.testing.assert_allclose(step.state.twist[:3], TWIST[:3], atol=0.15)


def test_a_scan_that_fits_nowhere_keeps_prediction_and_map(drive):
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(len(scan(0).mask), 3))
    far = rng.uniform(60, 90, (len(direction), 1)) * direction / np.linalg.norm(direction, axis=1)[:, None]
    scans = [scan(number) for number in range(8)]
    scans[5] = changed(scans[5], points=far, mask=np.ones(len(far)))
    steps = run(scans)
    assert steps[5].output.lost
    assert leaves_equal(steps[5].state.map, steps[4].state.map)
    assert not steps[5].output.added.any()
    np.testing.assert_allclose(
        steps[5].T_world_imu,
        steps[4].T_world_imu @ moved(np.asarray(steps[4].state.twist), PERIOD),
        atol=1e-9,
    )
    assert not steps[6].output.lost
    assert apart(steps[7].T_world_imu, expected_pose(end_of(7)))[0] < 0.08


def test_range_limits_hold():
    params = params_with(lidar__min_range=8.0, lidar__max_range=14.0)
    output = run([scan(0, twist=np.zeros(6))], params)[0].output
    points = np.asarray(output.points)[np.asarray(output.points_mask)] + np.asarray(output.origin)
    ranges = np.linalg.norm(points, axis=1)
    assert 8.0 - 1e-3 < ranges.min() < 8.3
    assert 13.7 < ranges.max() < 14.0 + 1e-3


def test_overflow_of_the_capacities_is_reported():
    assert run([scan(0)])[0].output.thinned_away == 0
    finer = run([scan(0)], params_with(registration__point_spacing=0.05, map__point_spacing=0.05))[0]
    assert finer.output.thinned_away > 500


def test_a_full_map_is_reported_and_nothing_else_breaks():
    params = params_with(map__voxel_size=0.35, map__point_spacing=0.05, registration__point_spacing=0.2)
    steps = run([scan(number) for number in range(SCANS)], params)
    # within reach all the time, and together more than the table has slots
    assert sum(int(step.output.map_dropped) for step in steps) > 50
    for step in steps:
        missing = int(step.output.points_mask.sum() - step.output.added.sum())
        assert step.output.map_dropped <= missing
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(step.state))


def test_one_program_served_all_of_it():
    assert STEP._cache_size() == 1
