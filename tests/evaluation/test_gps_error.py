"""Trajectories against simulated fixes: the errors that come out are those that were put in."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.data.sequence import GpsData
from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.gps_error import evaluate_gps, format_gps_evaluation
from lio_jax.settings.settings import Settings, with_overrides
from tests.loops.drives import LEVER, SHIFT, YAW, drive, poses_at

SETTINGS = with_overrides(Settings(), [f"params.gps.lever_arm={LEVER.tolist()}"])


def recorded(length=800, sigma=0.0, seed=0, rate=5.0):
    """Return the true trajectory of a drive and its fixes: a circle of 200 m, 10 m/s."""
    seen = drive(length, sigma, rate, seed)
    inside = seen.fix_ns <= seen.stamp_ns[-1]
    fixes = GpsData(seen.fix_ns[inside], seen.fix[inside], seen.covariance[inside], (48.0, 11.0, 500.0))
    return Trajectory(seen.stamp_ns, seen.T_odom_imu), fixes


def test_a_true_trajectory_has_the_errors_of_the_fixes():
    trajectory, fixes = recorded(sigma=0.5)
    found = evaluate_gps(trajectory, fixes, SETTINGS)
    assert (found.compared, found.fixes, found.left_out, found.notes) == (len(fixes.stamp_ns),) * 2 + ({}, ())
    # the mean square in the plane is twice that of an axis
    assert found.horizontal.rmse == pytest.approx(0.5 * np.sqrt(2), rel=0.07)
    assert found.vertical.rmse == pytest.approx(0.5, rel=0.07)
    # medians of the Rayleigh distribution and of the folded normal distribution
    assert found.horizontal.median == pytest.approx(0.5 * np.sqrt(2 * np.log(2)), rel=0.1)
    assert found.vertical.median == pytest.approx(0.5 * 0.6745, rel=0.1)
    assert found.horizontal.fix_sigma == found.vertical.fix_sigma == pytest.approx(0.5)
    assert found.horizontal.inside_3_sigma == pytest.approx(0.9973, abs=0.005)
    assert found.vertical.inside_3_sigma == pytest.approx(0.9973, abs=0.008)
    np.testing.assert_allclose(np.array(found.T_enu_world)[:3, 3], SHIFT, atol=0.3)
    yaw = Rotation.from_matrix(np.array(found.T_enu_world)[:3, :3]).as_euler("ZYX")[0]
    assert yaw == pytest.approx(YAW, abs=5e-3)
    assert found.path_length_m == pytest.approx(799, rel=0.03)


def test_exact_fixes_leave_the_error_of_the_interpolation():
    """Poses a metre apart on a circle of 200 m: the chord is 0.6 mm inside; the roll turns the antenna."""
    trajectory, fixes = recorded()
    found = evaluate_gps(trajectory, fixes, SETTINGS)
    assert found.horizontal.max < 2e-3
    assert found.drift_m_per_100_m == pytest.approx(0.0, abs=2e-3)
    without = evaluate_gps(trajectory, fixes)
    # the yaw explains an offset along the circle, but nothing explains another radius
    assert without.horizontal.rmse == pytest.approx(abs(LEVER[1]), rel=0.15)


def test_a_wave_on_the_trajectory_is_measured():
    """Sideways and up by a sine of many periods, which neither yaw nor translation takes away."""
    trajectory, fixes = recorded()
    seconds = trajectory.stamp_ns * 1e-9
    wrong = trajectory.poses.copy()
    wrong[:, 0, 3] += 0.8 * np.sin(2.0 * seconds)
    wrong[:, 2, 3] += 0.3 * np.cos(2.0 * seconds)
    found = evaluate_gps(Trajectory(trajectory.stamp_ns, wrong), fixes, SETTINGS)
    assert found.horizontal.rmse == pytest.approx(0.8 / np.sqrt(2), rel=0.03)
    assert found.vertical.rmse == pytest.approx(0.3 / np.sqrt(2), rel=0.03)
    assert found.horizontal.max == pytest.approx(0.8, rel=0.05)
    # of sigma 0.1 m: the wave is within 3 sigma for that share of its period, and of two axes one is right
    assert found.vertical.inside_3_sigma == pytest.approx(1.0, abs=0.02)
    assert found.horizontal.inside_3_sigma < 0.9


def test_a_scale_error_is_a_drift():
    """1 % too long: over a chord of 100 m of the circle the error changes by 1 % of the chord."""
    trajectory, fixes = recorded()
    wrong = trajectory.poses.copy()
    wrong[:, :3, 3] *= 1.01
    found = evaluate_gps(Trajectory(trajectory.stamp_ns, wrong), fixes, SETTINGS)
    chord = 2 * 200 * np.sin(100 / 1.01 / 200 / 2)
    assert found.drift_m_per_100_m == pytest.approx(0.01 * chord, rel=0.03)
    assert found.left_out == {}


def test_the_rotation_and_the_place_of_the_world_do_not_matter():
    trajectory, fixes = recorded(300, sigma=0.3)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", -2.5).as_matrix(), [300.0, 20.0, -4.0]
    one = evaluate_gps(trajectory, fixes, SETTINGS)
    other = evaluate_gps(Trajectory(trajectory.stamp_ns, T @ trajectory.poses), fixes, SETTINGS)
    for axis in ("horizontal", "vertical"):
        assert getattr(one, axis).rmse == pytest.approx(getattr(other, axis).rmse, rel=1e-6)


def test_jumps_coarse_and_impossible_fixes_are_left_out_and_counted():
    trajectory, fixes = recorded(400, sigma=0.3)
    position, covariance = fixes.position.copy(), fixes.covariance.copy()
    jumps, coarse, lost = [50, 51, 120], [70, 71], [90]
    position[jumps] += [40.0, -30.0, 0.0]
    covariance[coarse] *= 1e5
    position[lost] = np.nan
    bad = replace(fixes, position=position, covariance=covariance)
    found = evaluate_gps(trajectory, bad, SETTINGS)
    assert found.left_out == {
        "without a possible position, time or order": 1,
        "with a variance above params.gps.max_variance": 2,
        "that contradict their neighbours (jumps)": 3,
    }
    assert found.compared == len(fixes.stamp_ns) - 6
    assert "GPS: 1 GPS fix(es) without a possible position were left out." in found.notes
    right = np.setdiff1d(np.arange(len(fixes.stamp_ns)), jumps + coarse + lost)
    kept = GpsData(fixes.stamp_ns[right], fixes.position[right], fixes.covariance[right], fixes.origin)
    assert found.horizontal == evaluate_gps(trajectory, kept, SETTINGS).horizontal
    assert "left out: 3 that contradict their neighbours (jumps)" in format_gps_evaluation(found)


def test_fixes_outside_the_run_and_in_its_holes_are_left_out():
    trajectory, fixes = recorded(400)
    number = np.arange(len(trajectory))
    kept = (number < 100) | ((number > 150) & (number < 300))
    part = Trajectory(trajectory.stamp_ns[kept], trajectory.poses[kept])
    found = evaluate_gps(part, fixes, SETTINGS)
    at = fixes.stamp_ns * 1e-9
    assert found.left_out == {
        "outside the trajectory's time span": int(np.sum(at > 29.9)),
        "in holes of the trajectory": int(np.sum((at > 9.9) & (at < 15.1))),
    }
    assert found.horizontal.max < 5e-3


def test_a_short_way_says_that_its_heading_is_not_known():
    trajectory, fixes = recorded(8, sigma=2.0)
    found = evaluate_gps(trajectory, fixes, SETTINGS)
    assert "too coarse to show the heading" in found.notes[0]
    assert found.drift_m_per_100_m is None
    assert "path shorter than 100 m" in format_gps_evaluation(found)
    standing = Trajectory(trajectory.stamp_ns, np.tile(poses_at(np.zeros(1)), (len(trajectory), 1, 1)))
    assert "to show the heading" in evaluate_gps(standing, fixes, SETTINGS).notes[0]


def test_no_common_time_is_an_error():
    trajectory, fixes = recorded(50)
    later = replace(fixes, stamp_ns=fixes.stamp_ns + 10**12)
    with pytest.raises(LioJaxError, match=r"No GPS fix of the recording lies in the time span of the traj"):
        evaluate_gps(trajectory, later)
    two = GpsData(fixes.stamp_ns[:2], fixes.position[:2], fixes.covariance[:2], fixes.origin)
    with pytest.raises(LioJaxError, match=r"2 of 2 GPS fixes can be compared with .*, at least 3"):
        evaluate_gps(trajectory, two)
    nowhere = Trajectory(trajectory.stamp_ns, np.full_like(trajectory.poses, np.nan))
    with pytest.raises(LioJaxError, match="no pose with finite numbers"):
        evaluate_gps(nowhere, fixes)


def test_the_numbers_are_plain_json():
    trajectory, fixes = recorded(300, sigma=0.3)
    found = evaluate_gps(trajectory, fixes, SETTINGS)
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False))["horizontal"]["rmse"] > 0
