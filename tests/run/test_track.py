"""Scan after scan through the step: truth, faults in the stream, and nothing that grows with its length."""

import gc
from dataclasses import replace
from itertools import cycle, islice

import jax
import numpy as np
import pytest

from lio_jax.run.compiled import CompiledStep
from lio_jax.run.track import track
from lio_jax.settings.settings import Settings, with_overrides
from tests.run.small_drive import COUNT, PERIOD_NS, moving, shifted, standing, truth, without_points


def _errors(tracked):
    """Position errors in m, the truth laid into the world of the first pose's time."""
    known = truth().at(np.array([item.stamp_ns for item in tracked])).poses
    estimated = np.stack([item.T_world_imu for item in tracked])
    return np.linalg.norm((estimated - estimated[0] @ np.linalg.inv(known[0]) @ known)[:, :3, 3], axis=1)


def test_follows_the_truth(tracked):
    assert [item.stamp_ns for item in tracked] == [scan.end_ns for scan in moving()]
    assert not any(item.failure for item in tracked)
    # measured: 0.04 m; the first scan, of unknown velocity, is the worst
    assert _errors(tracked).max() < 0.08


def test_stages_add_up(tracked):
    for item in tracked:
        assert item.stage_ms["total"] == pytest.approx(item.stage_ms["pad"] + item.stage_ms["step"])
        assert item.stage_ms["pad"] > 0


def test_compile_time_is_no_step_time(settings, step, tracked):
    compile_s = step.init_programs.compile_s + step.step_programs.compile_s
    assert compile_s > 0.2
    assert tracked[0].stage_ms["step"] < 1e3 * compile_s


def test_empty_scan_in_the_middle_is_predicted_and_said(settings, step, tracked):
    scans = list(moving())
    scans[6] = without_points(scans[6])
    seen = list(track(settings, scans, step=step))
    assert [item.index for item in seen if item.failure] == [6]
    assert seen[6].failure == "it holds no points; the pose is the prediction."
    assert _errors(seen)[6] < 0.1
    assert _errors(seen)[-1] < 0.1


def test_first_scans_without_points_wait_for_the_map(settings, step):
    scans = [without_points(scan) for scan in moving()[:2]] + list(moving()[2:6])
    seen = list(track(settings, scans, step=step))
    assert [bool(item.failure) for item in seen] == [True, True, False, False, False, False]
    assert _errors(seen[2:]).max() < 0.1


def test_scan_of_another_place_is_lost_and_said(settings, step):
    scans = list(moving())
    scans[6] = replace(scans[6], points=scans[6].points + np.float32([0, 0, 60]))
    seen = list(track(settings, scans, step=step))
    assert "points matched the map, 50 are needed" in seen[6].failure
    assert _errors(seen)[-1] < 0.1


def test_points_that_are_not_finite_do_not_reach_the_pose(settings, step):
    scans = list(moving()[:4])
    points = scans[2].points.copy()
    points[::7], points[3::7, 1] = np.nan, np.inf
    scans[2] = replace(scans[2], points=points)
    seen = list(track(settings, scans, step=step))
    assert not any(item.failure for item in seen)
    assert _errors(seen).max() < 0.1


def test_runs_with_one_step_do_not_remember_each_other(settings, step, tracked):
    again = list(track(settings, moving(), step=step))
    for one, other in zip(tracked, again, strict=True):
        assert one.T_world_imu.tobytes() == other.T_world_imu.tobytes()


def _replayed(scans, count):
    """The standing vehicle's scans again and again, time going on."""
    return (
        shifted(scan, (number // COUNT) * COUNT * PERIOD_NS)
        for number, scan in enumerate(islice(cycle(scans), count))
    )


def test_neither_programs_nor_device_buffers_grow(settings):
    step = CompiledStep(settings)
    alive, compiled = [], []
    for item in track(settings, _replayed(standing(), 150), step=step):
        assert not item.failure
        if item.index % 25 == 10:
            del item
            gc.collect()
            alive.append(len(jax.live_arrays()))
            compiled.append(step.compile_s)
    assert len(set(alive)) == 1
    assert len(set(compiled)) == 1


def test_scan_sizes_within_a_bucket_share_a_program(settings):
    step = CompiledStep(settings)
    first, second, third, *_ = standing()
    fewer = replace(
        third,
        **{name: getattr(third, name)[:5000] for name in ("points", "time", "ring", "intensity")},
    )
    compiled = [step.compile_s for _ in track(settings, [first, second, fewer], step=step)]
    assert compiled[1] == compiled[2]


def test_a_straggler_compiles_no_program_of_its_own(settings):
    sizes = with_overrides(settings, ["config.lidar.buckets=[100,8192]"])
    step = CompiledStep(sizes)
    scans = list(standing()[:5])
    scans[2] = without_points(scans[2])
    seen = list(track(sizes, scans, step=step))
    assert [bool(item.failure) for item in seen] == [False, False, True, False, False]
    assert len(step.step_programs) == 1


def test_unknown_recipe_lists_those_there_are():
    with pytest.raises(Exception, match=r"recipe 'lio_sam2' is not known; there are: default"):
        CompiledStep(Settings(recipe="lio_sam2"))
