"""The registered clouds of a run, against the surfaces and the poses of simulated drives."""

import shutil

import numpy as np
import pytest
from pypcd4 import PointCloud

from lio_jax.data.sequence import LidarScan, SequenceInfo
from lio_jax.run.folder import run_folder
from lio_jax.run.run import run_sequence, settings_for
from lio_jax.run.scan_clouds import FOLDER
from lio_jax.settings.settings import recipe_settings, with_overrides
from tests.full_disk import full_disk_after
from tests.recipes import drive as hall_drive
from tests.run import inertial_drive
from tests.run.inertial_drive import InertialReplay
from tests.run.small_drive import COUNT, Replay, moving, without_points
from tests.run.test_resume import Copying, contents, often, resumable  # noqa: F401

NEAR = 30.0
"""Points within this range are compared, m: farther ones show errors of the angular rate."""
ALL = ["config.output.clouds=all"]


def clouds(folder):
    """Return the written clouds by the number in their names, with a column for each field."""
    found = {int(path.stem): PointCloud.from_path(path) for path in sorted((folder / FOLDER).iterdir())}
    return {number: cloud.numpy(cloud.fields) for number, cloud in found.items()}


def in_range(scan, settings):
    lidar, ranges = settings.values["lidar"], np.linalg.norm(scan.points, axis=1)
    return (ranges > lidar["min_range"]) & (ranges < lidar["max_range"])


def hall_scan(number):
    scan = hall_drive.scan(number)
    kept = np.asarray(scan.mask)
    return LidarScan(
        stamp_ns=number * 100_000_000,
        points=np.asarray(scan.points)[kept],
        time=np.asarray(scan.time)[kept],
        ring=np.asarray(scan.ring)[kept],
        intensity=np.full(np.count_nonzero(kept), number, np.float32),
        duration=hall_drive.PERIOD,
    )


def distance_to_hall(points):
    """Return the distance of (n, 3) points from the nearest surface of the hall, m."""
    found = [np.abs(np.abs(points[:, axis]) - half) for axis, half in enumerate((17, 11, 3.5))]
    boxes = hall_drive.WORLD.solids.boxes
    for centre, half, yaw in zip(boxes.center, boxes.half_size, boxes.yaw, strict=True):
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        outside = np.abs((points - centre) @ turn) - half
        beyond = np.linalg.norm(np.maximum(outside, 0), axis=1)
        found.append(np.abs(beyond + np.minimum(outside.max(axis=1), 0)))
    for x, y in ((5.0, -4.0), (-5.0, 5.0), (12.0, 3.0), (-12.0, -2.0)):
        found.append(np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - 0.3))
    return np.min(found, axis=0)


@pytest.fixture(scope="module")
def in_hall(tmp_path_factory):
    """Run through the hall at 6 m/s without inertial samples; return folder, scans and settings."""
    scans = [hall_scan(number) for number in range(6)]
    recording = Replay(scans)
    recording.info = SequenceInfo("hall", "memory", "memory", len(scans), np.eye(4))
    values = [f"params.{path.replace('__', '.')}={value}" for path, value in hall_drive.HALL.items()]
    settings, _ = settings_for(recording, with_overrides(recipe_settings("default"), ALL + values))
    folder = tmp_path_factory.mktemp("hall")
    result = run_sequence(recording, settings, folder)
    return folder, scans, settings, result


def test_all_points_lie_on_the_surfaces_of_the_world(in_hall):
    folder, scans, _, _ = in_hall
    T_hall_world = hall_drive.lidar_pose(hall_drive.PERIOD)
    written = clouds(folder)
    for number in range(len(scans)):
        points = written[number][:, :3].astype(float) @ T_hall_world[:3, :3].T + T_hall_world[:3, 3]
        distance = distance_to_hall(points)
        # the ranges' noise is 10 mm and the poses' error about 20 mm, which grazing beams see in full;
        # without compensation the first points of a scan are 0.6 m off
        assert np.median(distance) < 0.015
        assert np.quantile(distance, 0.98) < 0.08
        T_hall_lidar = hall_drive.lidar_pose((number + 1) * hall_drive.PERIOD)
        uncompensated = scans[number].points @ T_hall_lidar[:3, :3].T + T_hall_lidar[:3, 3]
        assert np.quantile(distance_to_hall(uncompensated), 0.98) > 0.3


def test_each_file_holds_the_valid_points_of_its_scan_and_their_intensities(in_hall):
    folder, scans, settings, result = in_hall
    written = clouds(folder)
    assert list(written) == list(range(len(scans)))
    for number, scan in enumerate(scans):
        assert len(written[number]) == np.count_nonzero(in_range(scan, settings))
        # the first scan's intensities are zero; the columns are those of the first file
        assert written[number].shape[1] == 3
    total = sum(len(cloud) for cloud in written.values())
    assert result.metrics["clouds"] == {"files": len(scans), "points": total}


RECIPES = [
    "default",
    *(pytest.param(name, marks=pytest.mark.long) for name in ("fast_lio2", "lio_sam", "loam")),
]


@pytest.mark.parametrize("name", RECIPES)
def test_points_lie_as_the_true_motion_within_the_sweep_puts_them(tmp_path, name):
    scans = inertial_drive.scans(40, 52)
    recording = InertialReplay(scans, inertial_drive.imu())
    settings, _ = settings_for(recording, with_overrides(recipe_settings(name), ALL))
    result = run_sequence(recording, settings, tmp_path)
    drive, written = inertial_drive.drive(), clouds(tmp_path)
    T_imu_lidar, first_ns = drive.info.T_imu_lidar, inertial_drive.scan(0).stamp_ns
    for number, scan in enumerate(scans):
        kept = in_range(scan, settings)
        assert len(written[number]) == np.count_nonzero(kept)
        np.testing.assert_array_equal(written[number][:, 3], scan.intensity[kept])
        times, row = np.unique(scan.time[kept], return_inverse=True)
        seconds = (scan.stamp_ns - first_ns) * 1e-9 + np.append(times, scan.duration).astype(float)
        T_world_lidar = drive.poses(seconds) @ T_imu_lidar
        T_end_lidar = np.linalg.inv(T_world_lidar[-1]) @ T_world_lidar[row]
        true = np.einsum("nij,nj->ni", T_end_lidar[:, :3, :3], scan.points[kept]) + T_end_lidar[:, :3, 3]
        # the scan lies at its own pose of the trajectory
        T_found = result.trajectory.poses[number] @ T_imu_lidar
        there = (written[number][:, :3] - T_found[:3, 3]) @ T_found[:3, :3]
        near = np.linalg.norm(true, axis=1) < NEAR
        error = np.linalg.norm(there - true, axis=1)
        # what is left is the error of the estimated velocity and rate, in m per sweep
        assert np.quantile(error[near], 0.95) < (0.05 if name == "default" else 0.15)
        skewed = np.linalg.norm(scan.points[kept] - true, axis=1)
        assert np.quantile(skewed[near], 0.95) > 0.4


def test_without_the_setting_there_is_no_folder(tmp_path, settings):
    run_sequence(Replay(moving()[:3]), settings, tmp_path)
    assert not (tmp_path / FOLDER).exists()


def test_scans_are_joined_by_the_interval(tmp_path, settings):
    scans = list(moving())
    scans[4] = without_points(scans[4])
    each = with_overrides(settings, ALL)
    run_sequence(Replay(scans), each, tmp_path / "each", start=1)
    single = clouds(tmp_path / "each")
    assert list(single) == [number for number in range(1, COUNT) if number != 4]
    for interval, firsts in ((5, [1, 6, 11]), (0, [1])):
        joined = with_overrides(each, [f"config.output.clouds_interval={interval}"])
        run_sequence(Replay(scans), joined, tmp_path / str(interval), start=1)
        several = clouds(tmp_path / str(interval))
        assert list(several) == firsts
        np.testing.assert_array_equal(
            np.concatenate(list(several.values())), np.concatenate(list(single.values()))
        )


def test_thinned_points_are_those_of_the_recipe(tmp_path, settings, tracked):
    thinned = with_overrides(settings, ["config.output.clouds=thinned"])
    run_sequence(Replay(moving()), thinned, tmp_path)
    written = clouds(tmp_path)
    for result in tracked:
        output = result.output
        points = np.asarray(output.points)[np.asarray(output.points_mask)] + np.asarray(output.origin)
        np.testing.assert_allclose(written[result.index], points, atol=1e-5)


@pytest.mark.parametrize("name", RECIPES)
def test_the_matched_points_are_those_that_met_the_map(tmp_path, name):
    scans = inertial_drive.scans(40, 46)
    recording = InertialReplay(scans, inertial_drive.imu())
    wanted = ["config.output.clouds=thinned", "config.registration.mark_matched=true"]
    settings, _ = settings_for(recording, with_overrides(recipe_settings(name), wanted))
    run_sequence(recording, settings, tmp_path)
    found = {
        path.stem: PointCloud.from_path(path).numpy(("x", "y", "z")) for path in (tmp_path / FOLDER).iterdir()
    }
    assert "000000_matched" not in found, "there was no map"
    matches = np.load(tmp_path / "scans.npz")["matches"]
    for number in range(1, len(scans)):
        thinned, matched = found[f"{number:06d}"], found[f"{number:06d}_matched"]
        assert {tuple(point) for point in matched} <= {tuple(point) for point in thinned}
        # the last linearisation lies one step before the solution, where some scores are others
        assert len(matched) == pytest.approx(matches[number], rel=0.05)
        assert len(matched) < len(thinned)


@pytest.mark.parametrize("interval", [1, 5])
def test_a_killed_run_that_goes_on_writes_each_scan_once(tmp_path, settings, interval):
    wanted = with_overrides(settings, [*ALL, f"config.output.clouds_interval={interval}"])
    whole, out = tmp_path / "whole", tmp_path / "7"
    resumable(Replay(moving()), wanted, whole, [Copying(whole, tmp_path, (7,))])
    resumable(Replay(moving()), wanted, out)
    assert contents(out) == contents(whole)
    assert [path.name for path in out.rglob(".*")] == []


def test_an_interrupted_run_completes_its_last_file_and_goes_on(tmp_path, settings):
    class Stopping(Copying):
        def take(self, result):
            if result.index == 7:
                raise KeyboardInterrupt

    wanted = with_overrides(settings, [*ALL, "config.output.clouds_interval=5"])
    out = tmp_path / "out"
    resumable(Replay(moving()), wanted, tmp_path / "whole")
    resumable(Replay(moving()), wanted, out, [Stopping(out, tmp_path, ())])
    assert list(clouds(out)) == [0, 5]
    resumable(Replay(moving()), wanted, out)
    assert contents(out) == contents(tmp_path / "whole")


def test_a_full_disk_ends_the_run_with_what_there_is(tmp_path, settings):
    wanted = with_overrides(settings, [*ALL, "config.output.clouds_interval=0"])
    limit = 16 * sum(len(scan.points) for scan in moving()[:4])
    with full_disk_after(limit):
        result = run_sequence(Replay(moving()), wanted, tmp_path)
    assert isinstance(result.interruption, OSError)
    assert list((tmp_path / FOLDER).iterdir() if (tmp_path / FOLDER).exists() else []) == []
    assert (tmp_path / "trajectory.tum").exists()


def test_the_clouds_of_an_earlier_run_are_replaced_and_nothing_else(tmp_path, settings):
    wanted = with_overrides(settings, ALL)
    run_sequence(Replay(moving()[:3]), wanted, tmp_path)
    (tmp_path / FOLDER / "mine.pcd").write_text("kept")
    with run_folder(tmp_path, overwrite=True):
        assert [path.name for path in (tmp_path / FOLDER).iterdir()] == ["mine.pcd"]
    shutil.rmtree(tmp_path / FOLDER)
