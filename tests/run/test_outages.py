"""After an outage every recipe goes on: few scans are lost, and the covariance covers the error."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.run.keyframes import KeyframePicker
from lio_jax.run.run import run_sequence, settings_for
from lio_jax.run.verdict import Verdict
from lio_jax.settings.settings import recipe_settings, with_overrides
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from tests.run.roads import relative, road, steps, tracked
from tests.run.small_drive import Replay

BEFORE, AWAY, AFTER = 30, 100, 30
RECIPES = [
    "default",
    "fast_lio2",
    pytest.param("lio_sam", marks=pytest.mark.long),
    pytest.param("loam", marks=pytest.mark.long),
]


@cache
def drive():
    sequence = SimulatedSequence(
        "city", beams=16, duration_s=0.1 * (BEFORE + AWAY + AFTER), seed=3, imu=ImuModel()
    )
    return sequence, tuple(sequence.scans(0, BEFORE)), tuple(sequence.scans(BEFORE + AWAY, AFTER))


def blocked(scan):
    """Return the returns of something that covers the sensor."""
    points = np.random.default_rng(0).normal(size=(len(scan.points), 3)).astype(np.float32) * 0.1
    return replace(scan, points=points)


def with_blocked():
    sequence, before, after = drive()
    return sequence, (*before, *map(blocked, sequence.scans(BEFORE, AWAY)), *after)


def without_scans():
    sequence, before, after = drive()
    return sequence, (*before, *after)


@pytest.mark.parametrize("recording", [without_scans, with_blocked])
@pytest.mark.parametrize("recipe", RECIPES)
def test_odometry_goes_on_after_ten_seconds_without_a_match(recipe, recording):
    sequence, scans = recording()
    settings, results = tracked(sequence, recipe, scans=scans)
    after = results[-AFTER:]
    assert sum(bool(one.output.lost) for one in after) <= 5
    poses, truth = relative(after[5:], sequence)
    assert np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]) < 0.02 * steps(truth).sum() + 0.05
    error = np.subtract(*(one[-1, :3, 3] for one in relative(results, sequence)))
    covariance = results[-1].output.covariance
    if covariance is not None:
        # the position's covariance is in the body's axes; its trace is that of all axes
        sigma = np.sqrt(np.trace(np.asarray(covariance)[3:6, 3:6]))
        assert np.linalg.norm(error) < 3 * sigma
    judge = Verdict(settings)
    for one in results:
        judge.take(one)
    verdict = judge.verdict()
    assert (verdict["state"] == "sound") <= (np.linalg.norm(error) < 1.0)
    if np.linalg.norm(error) > 1:
        assert verdict["since_s"] == pytest.approx(0.1 * (BEFORE - 1), abs=0.2)
    assert any("a new piece of map begins" in one.failure for one in after)


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_sensor_that_is_blocked_from_the_start_begins_where_it_sees_something(recipe):
    sequence, _, after = drive()
    scans = (*map(blocked, sequence.scans(BEFORE + AWAY - 20, 20)), *after)
    _, results = tracked(sequence, recipe, scans=scans)
    assert not any(bool(one.output.lost) for one in results[20:])
    poses, truth = relative(results[20:], sequence)
    assert np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3]) < 0.02 * steps(truth).sum() + 0.05


@pytest.mark.parametrize("recipe", RECIPES)
def test_without_an_outage_no_piece_begins(recipe):
    sequence, before, _ = drive()
    _, results = tracked(sequence, recipe, scans=before)
    assert not any(bool(one.output.new_piece) for one in results)


@pytest.mark.parametrize("recipe", ["default", "loam"])
def test_a_new_piece_is_a_keyframe_that_knows_how_wrong_it_may_be(recipe):
    sequence, scans = with_blocked()
    settings, results = tracked(sequence, recipe, scans=scans)
    pick = KeyframePicker(settings)
    keyframes = [picked for one in results if (picked := pick(one)) is not None]
    (begin,) = [one for one in keyframes if one.begins_piece]
    assert pick.pieces == [begin.index]
    assert begin.stamp_ns == results[BEFORE + AWAY].stamp_ns
    error = np.subtract(*(one[BEFORE + AWAY, :3, 3] for one in relative(results, sequence)))
    assert np.linalg.norm(error) < begin.position_error < 500
    assert np.trace(begin.covariance[3:, 3:]) > np.linalg.norm(error) ** 2 / 9
    lost = {one.stamp_ns for one in results if bool(one.output.lost)} - {begin.stamp_ns}
    assert all(len(one.points) == 0 for one in keyframes if one.stamp_ns in lost)
    assert all(len(one.points) > 100 for one in keyframes if one.stamp_ns not in lost)


def test_a_run_says_whether_anything_ties_the_pieces(tmp_path):
    sequence, scans = without_scans()
    settings = with_overrides(recipe_settings("default"), ["config.backend.loops=true"])
    recording = Replay(scans)
    recording.info, recording.imu, recording.truth = sequence.info, sequence.imu, sequence.truth
    result = run_sequence(recording, settings_for(recording, settings)[0], tmp_path / "run")
    (said,) = [words for words in result.metrics["warnings"] if "a new piece of map" in words]
    assert said.endswith("nothing ties it to the map before; its place there is predicted.")


@pytest.mark.parametrize("recipe", ["default", "fast_lio2", "loam"])
def test_a_turn_that_nothing_measures_does_not_go_on_through_an_outage(recipe):
    sequence = road("street", 8.0, 0.5, 80, imu=False)
    scans = list(sequence.scans())
    covered = (*scans[:20], *map(blocked, scans[20:70]), *scans[70:])
    _, results = tracked(sequence, recipe, scans=covered)
    R = [one.T_world_imu[:3, :3] for one in results]
    assert Rotation.from_matrix(R[19].T @ R[69]).magnitude() < 0.5 * 1.5
    moved = np.linalg.norm(results[69].T_world_imu[:3, 3] - results[19].T_world_imu[:3, 3])
    assert moved == pytest.approx(8.0 * 5, rel=0.1)
