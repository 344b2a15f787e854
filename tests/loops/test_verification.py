"""Loops in simulated places: right ones are accepted with the right pose, others refused with a reason."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from loops import error_of
from simulated_keyframes import driven, keyframes_of, times_along

from lio_jax.loops.proposals import external_proposal
from lio_jax.loops.verification import verify
from lio_jax.settings.settings import Settings, recipe_settings
from lio_jax.sim.assembly import assembled
from lio_jax.sim.blocks import LANE, lap
from lio_jax.sim.lidar import spinning_lidar
from lio_jax.sim.sequence import build
from tests.loops.places import pose

SETTINGS = Settings()
LIMITS = SETTINGS.values["loop"]
SENSOR = spinning_lidar(16, 360, elevation_deg=(-15.0, 15.0))
FIRST, AGAIN, SPACING = 40, 10, 2.0
"""Keyframes of the first pass and of the second, and the way between them, m."""
WRONG = pose(6.0, -7.0, 0.5, 0.12)
"""Drift of the odometry between the passes, at the second pass's end."""


def straight(x, y, count, heading=1.0):
    along = x + heading * SPACING * np.arange(count)
    return np.stack([along, np.full(count, y)], axis=1)


def passes(world, first, second, above, wrong=WRONG):
    """Return keyframes of two passes that lie 100 s apart, their true poses, and those of the odometry."""
    truth = np.concatenate([driven(world, path, above=above) for path in (first, second)])
    times = times_along(truth)
    times[FIRST:] += 100.0
    odometry = truth.copy()
    about = pose(*truth[-1, :3, 3])
    odometry[FIRST:] = about @ wrong @ np.linalg.inv(about) @ truth[FIRST:]
    return keyframes_of(world, truth, odometry, times, SENSOR), truth, odometry


@cache
def city(again):
    """Drive along a street of the city, and there again: so, in the other lane, or elsewhere."""
    world = build("city", 3).world
    x, y = lap()[0]
    start = straight(10 - x, -LANE - y, FIRST)
    end = {
        "same way": straight(35 - x, -LANE - y, AGAIN),
        "other lane": straight(65 - x, LANE - y, AGAIN, heading=-1.0),
        "another street": straight(35 - x, 60 - LANE - y, AGAIN),
    }[again]
    return passes(world, start, end, above=8.0)


def proposed(keyframes, truth, odometry, target, metres):
    """Return a proposal from the last keyframe whose place is as wrong as the odometry, within 12 m."""
    proposal = external_proposal(len(keyframes) - 1, target, None, odometry, metres, LIMITS)
    return replace(proposal, origin="radius", shift_error=12.0)


def nearest(truth):
    return int(np.argmin(np.linalg.norm(truth[:FIRST, :3, 3] - truth[-1, :3, 3], axis=1)))


@pytest.mark.parametrize("again", ["same way", "other lane"])
def test_a_place_seen_again_is_accepted_with_its_pose(again):
    keyframes, truth, odometry = city(again)
    target = nearest(truth)
    proposal = proposed(keyframes, truth, odometry, target, 500.0)
    verdict = verify(proposal, keyframes, odometry, SETTINGS)
    assert verdict.accepted, verdict.reason
    moved, turned = error_of(verdict.T_target_source, truth, len(truth) - 1, target)
    assert moved < 0.25
    assert turned < 0.01
    assert verdict.overlap > 0.9
    assert verdict.fitness < 0.1
    assert verdict.conflict < 0.15
    sigma = np.sqrt(np.diag(np.linalg.inv(verdict.information)))
    assert np.all((sigma[:3] >= LIMITS["rotation_sigma"]) & (sigma[:3] < 0.02))
    assert np.all((sigma[3:] >= LIMITS["translation_sigma"]) & (sigma[3:] < 0.5))


def test_the_settings_of_the_run_count():
    keyframes, truth, odometry = city("same way")
    proposal = proposed(keyframes, truth, odometry, nearest(truth), 500.0)
    verdict = verify(proposal, keyframes, odometry, SETTINGS)
    # the odometry's filter has a model of what neighbouring points share, and an alignment has none
    doubting = SETTINGS.with_value("params.registration.information_scale", 0.1, "test")
    np.testing.assert_array_equal(
        verify(proposal, keyframes, odometry, doubting).information, verdict.information
    )
    blunt = SETTINGS.with_value("params.lidar.range_sigma", 0.5, "test")
    assert not np.array_equal(verify(proposal, keyframes, odometry, blunt).information, verdict.information)


@pytest.mark.parametrize("recipe", ["fast_lio2", "loam", "lio_sam"])
@pytest.mark.parametrize("again", ["same way", "other lane", "another street"])
def test_every_recipe_accepts_the_same_places(again, recipe):
    keyframes, truth, odometry = city(again)
    target = 10 if again == "another street" else nearest(truth)
    proposal = proposed(keyframes, truth, odometry, target, 500.0)
    verdict = verify(proposal, keyframes, odometry, recipe_settings(recipe))
    assert verdict.accepted == (again != "another street"), verdict.reason


def test_another_place_is_refused_whatever_the_odometry_would_allow():
    keyframes, truth, odometry = city("another street")
    for target in (10, 25):
        proposal = proposed(keyframes, truth, odometry, target, 1e5)
        verdict = verify(proposal, keyframes, odometry, SETTINGS)
        assert not verdict.accepted
        assert "agree" in verdict.reason
        assert verdict.overlap < 0.6
        assert not verdict.information.any()


def test_a_correction_larger_than_the_odometry_can_be_wrong_is_refused():
    """The place is right, but the odometry, which ran 60 m since, cannot have been wrong by 9 m."""
    keyframes, truth, odometry = city("same way")
    proposal = proposed(keyframes, truth, odometry, nearest(truth), 60.0)
    verdict = verify(proposal, keyframes, odometry, SETTINGS)
    assert not verdict.accepted
    assert "more than it can be wrong" in verdict.reason


@pytest.mark.parametrize("same", [True, False])
def test_inside_a_smooth_tunnel_no_loop_is_closed(same):
    """Neither where it is the same place: nobody could know."""
    world = build("tunnel", 0).world
    there = straight(200.0, 0.0, FIRST)
    again = straight(230.0 if same else 300.0, 0.0, AGAIN)
    keyframes, truth, odometry = passes(world, there, again, above=3.0, wrong=pose(3.0, 0.5))
    target = nearest(truth) if same else 20
    proposal = proposed(keyframes, truth, odometry, target, 1e5)
    verdict = verify(proposal, keyframes, odometry, SETTINGS)
    assert not verdict.accepted
    assert "open" in verdict.reason or "another fit" in verdict.reason or "nothing upright" in verdict.reason


def test_where_nothing_stands_there_is_nothing_to_compare():
    plain = assembled([0.0, 0.0, 0.0], planes=[[0, 0, -1.6, 0, 0, 1, 0.2]])
    keyframes, truth, odometry = passes(plain, straight(0, 0, FIRST), straight(0, 0, AGAIN), above=8.0)
    verdict = verify(proposed(keyframes, truth, odometry, 5, 500.0), keyframes, odometry, SETTINGS)
    assert not verdict.accepted
    assert verdict.reason == "nothing upright to compare"


def test_a_place_with_a_twin_is_refused_without_being_aligned():
    keyframes, truth, odometry = city("same way")
    proposal = replace(proposed(keyframes, truth, odometry, nearest(truth), 500.0), twin=7)
    verdict = verify(proposal, keyframes, odometry, SETTINGS)
    assert not verdict.accepted
    assert "keyframe 7" in verdict.reason
