"""Which fixes keyframes are tied to: each gate, and what is wrong with recordings."""

import numpy as np
import pytest

from lio_jax.loops.gps import Fix, GpsGate, Refusal
from lio_jax.settings.settings import Settings, recipe_settings
from tests.loops.drives import LEVER, drive, to_enu

STEPS = np.linalg.norm(np.diff(drive(30).antennas(), axis=0), axis=1)
FIRST = 1 + int(np.argmax(np.cumsum(STEPS) >= 5.0))
"""The first keyframe at the end of five metres."""


def values(**changed):
    return Settings().values["gps"] | {"lever_arm": LEVER.tolist()} | changed


def choices(recorded, elevation=True, pose_covariance=None, corrected=None, position_error=None, **changed):
    """Return what each keyframe gets, and the gate."""
    gate = GpsGate(recorded.fix_ns, recorded.fix, recorded.covariance, values(**changed), elevation)
    corrected = recorded.T_odom_imu if corrected is None else corrected
    errors = np.zeros(len(corrected)) if position_error is None else position_error
    found = [
        gate.used_fix(stamp, T, T_world_imu, pose_covariance, error)
        for stamp, T, T_world_imu, error in zip(
            recorded.stamp_ns.tolist(), recorded.T_odom_imu, corrected, errors, strict=True
        )
    ]
    return found, gate


def used(found):
    return [number for number, each in enumerate(found) if isinstance(each, Fix)]


def test_a_fix_every_few_metres_at_the_antenna():
    recorded = drive()
    found, gate = choices(recorded)
    numbers = used(found)
    assert numbers[0] == FIRST
    assert set(np.diff(numbers)) <= {5, 6}
    truth = to_enu(recorded.antennas())
    errors = [np.linalg.norm(found[number].position - truth[number]) for number in numbers]
    assert max(errors) < 0.02
    assert gate.refusals == {Refusal.TRAVEL: FIRST, Refusal.NEAR: 200 - FIRST - len(numbers)}


def test_positions_between_fixes_are_interpolated_and_not_those_of_the_nearest():
    """One fix a second at 10 m/s: the nearest within 0.2 s is up to 2 m away."""
    recorded = drive(rate=1.0)
    truth = to_enu(recorded.antennas())

    def errors(**changed):
        found, _ = choices(recorded, **changed)
        return [np.linalg.norm(found[number].position - truth[number]) for number in used(found)]

    assert max(errors()) < 0.15
    assert max(errors(interpolation=0.0)) > 0.5


def test_the_nearest_fix_counts_as_less_certain_by_what_was_moved_since():
    recorded = drive(rate=1.0)
    found, _ = choices(recorded, interpolation=0.0, min_variance=1e-6)
    truth = to_enu(recorded.antennas())
    for number in used(found):
        missed = np.linalg.norm(found[number].position - truth[number])
        assert missed < 1.1 * np.sqrt(found[number].covariance[0, 0])


def test_an_outage_leaves_keyframes_alone():
    recorded = drive()
    out = (recorded.fix_ns > 8e9) & (recorded.fix_ns < 13e9)
    recorded.fix_ns, recorded.fix, recorded.covariance = (
        each[~out] for each in (recorded.fix_ns, recorded.fix, recorded.covariance)
    )
    found, gate = choices(recorded)
    numbers = np.array(used(found))
    assert not np.any((numbers > 82) & (numbers < 128))
    assert np.any(numbers > 130)
    assert gate.refusals[Refusal.TIME] > 40


def test_fixes_are_used_at_once_where_the_odometry_goes_on_elsewhere_after_an_outage():
    recorded = drive()
    recorded.T_odom_imu[100:, :3, 3] += [30.0, -20.0, 0.0]
    wrong = np.zeros(200)
    refused, _ = choices(recorded)
    wrong[100] = 40.0
    found, gate = choices(recorded, position_error=wrong)
    assert not set(range(101, 120)) & set(used(refused))
    assert set(range(101, 120)) & set(used(found))
    assert Refusal.JUMP not in gate.refusals


def test_no_fixes_at_all():
    recorded = drive(30)
    none = np.zeros((0, 3, 3))
    gate = GpsGate(recorded.fix_ns[:0], none[:, 0], none, values())
    found = [gate.used_fix(int(t), T, T) for t, T in zip(recorded.stamp_ns, recorded.T_odom_imu, strict=True)]
    assert set(found) == {Refusal.TRAVEL, Refusal.TIME}


def test_the_variance_gate_looks_at_east_and_north():
    recorded = drive()
    recorded.covariance[:] = np.diag([1.5, 1.5, 90.0])
    assert used(choices(recorded, max_variance=2.0)[0])
    recorded.covariance[:, 1, 1] = 2.5
    found, gate = choices(recorded, max_variance=2.0)
    assert not used(found)
    assert gate.refusals[Refusal.VARIANCE] == 200 - FIRST


def test_no_less_than_the_least_variance_is_believed():
    recorded = drive()
    recorded.covariance[:] = np.array([[0.04, 0.01, 0.0], [0.01, 3.0, 0.0], [0.0, 0.0, 1e-9]])
    found, _ = choices(recorded)
    covariance = found[used(found)[0]].covariance
    np.testing.assert_allclose(covariance, [[1.0, 0.01, 0.0], [0.01, 3.0, 0.0], [0.0, 0.0, 1.0]])


def test_a_certain_pose_does_without():
    recorded = drive()
    found, gate = choices(recorded, pose_covariance=np.diag([24.0, 24.0, 1e4]), pose_variance=25.0)
    assert not used(found)
    assert gate.refusals[Refusal.CERTAIN] == 200 - FIRST
    assert used(choices(recorded, pose_covariance=np.diag([24.0, 26.0, 0.0]), pose_variance=25.0)[0])
    assert used(choices(recorded, pose_variance=25.0)[0])


def test_without_elevation_the_height_is_that_of_the_corrected_antenna():
    recorded = drive()
    recorded.fix[:, 2] += 30 * np.random.default_rng(0).normal(size=len(recorded.fix))
    corrected = recorded.T_odom_imu.copy()
    corrected[:, 2, 3] += 4.0
    found, _ = choices(recorded, elevation=False, corrected=corrected, min_variance=1e-3)
    numbers = used(found)
    assert len(numbers) > 30
    for number in numbers:
        assert found[number].position[2] == pytest.approx(recorded.antennas()[number, 2] + 4.0)
        np.testing.assert_allclose(found[number].covariance[2], [0, 0, 0.01])


def none_is_far_off(recorded, found):
    """No pose is off by more than the motion in 0.1 s, half the time between two fixes."""
    truth = to_enu(recorded.antennas())
    assert all(np.linalg.norm(found[number].position - truth[number]) < 1.1 for number in used(found))


def test_one_fix_a_hundred_metres_off_is_refused_and_the_next_one_used():
    recorded = drive()
    at = np.searchsorted(recorded.fix_ns, 10e9)
    recorded.fix[at] += [60.0, 80.0, 0.0]
    found, gate = choices(recorded)
    none_is_far_off(recorded, found)
    assert gate.refusals[Refusal.JUMP] >= 1
    assert len(used(found)) >= len(used(choices(drive())[0])) - 1


@pytest.mark.parametrize("direction", [[0.0, 0.0, 100.0], [100.0, 0.0, 0.0], [-70.0, 70.0, 0.0]])
def test_a_stretch_a_hundred_metres_off_is_refused(direction):
    recorded = drive(300)
    recorded.fix[(recorded.fix_ns > 14e9) & (recorded.fix_ns < 18e9)] += direction
    found, _ = choices(recorded)
    none_is_far_off(recorded, found)
    assert max(used(found)) > 290


def test_a_first_fix_that_is_wrong_does_not_shut_out_the_others():
    recorded = drive()
    recorded.fix[recorded.fix_ns < 0.7e9] += [100.0, 0.0, 0.0]
    found, gate = choices(recorded)
    assert len(used(found)) > 25
    assert gate.refusals[Refusal.JUMP] > 0


def test_noise_as_stated_is_no_jump():
    refused = 0
    for seed in range(5):
        recorded = drive(sigma=2.0, seed=seed)
        _, gate = choices(recorded)
        refused += gate.refusals[Refusal.JUMP]
    assert refused == 0


def test_later_keyframes_do_not_change_what_was_chosen():
    recorded = drive(sigma=1.0)
    whole, _ = choices(recorded)
    recorded.stamp_ns, recorded.T_odom_imu = recorded.stamp_ns[:120], recorded.T_odom_imu[:120]
    part, _ = choices(recorded)
    assert used(part) == [number for number in used(whole) if number < 120]


def test_standing_keyframes_use_one_fix():
    recorded = drive(100)
    recorded.T_odom_imu[40:] = recorded.T_odom_imu[40]
    assert max(used(choices(recorded)[0])) <= 46


def test_lio_sams_values():
    gps = recipe_settings("lio_sam").values["gps"]
    expected = {"min_travel": 5.0, "pose_variance": 25.0, "time_gap": 0.2, "max_variance": 2.0}
    expected |= {"spacing": 5.0, "min_variance": 1.0, "height_variance": 0.01}
    assert {name: gps[name] for name in expected} == expected
    assert not recipe_settings("lio_sam").run.backend.gps_elevation
