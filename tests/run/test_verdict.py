"""A run ends with a verdict: sound, doubtful or lost, with the reason."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.cli import main
from lio_jax.data.detect import open_sequence
from lio_jax.run.felt_motion import FeltMotion
from lio_jax.run.run import settings_for
from lio_jax.run.scan_inputs import padded
from lio_jax.run.shown_motion import Agreement, MotionCheck, ShownMotion
from lio_jax.run.verdict import Verdict, in_words
from lio_jax.settings.settings import recipe_settings
from lio_jax.sim.sequence import SimulatedSequence
from tests.run.roads import lift_without_floor, relative, road, steps, tracked
from tests.run.test_first_velocity import DRIVE
from tests.shared_data import needs_shared

AT_REST = "params.initial.velocity=[0,0,0.001]"
"""Forbids the search for the first velocity, so that the scan match stays where it starts: at rest."""


def verdict_of(settings, results):
    judge = Verdict(settings)
    for one in results:
        judge.take(one)
    return judge.verdict()


def test_a_match_that_stays_at_rest_while_the_vehicle_drives_is_noticed():
    sequence = road("city", 40.0, 0.0, 12)
    settings, results = tracked(sequence, "default", [AT_REST])
    poses, truth = relative(results, sequence)
    assert steps(poses).sum() < 0.5 * steps(truth).sum()
    found = verdict_of(settings, results)
    assert found["state"] != "sound"
    assert found["since_s"] <= 0.3
    assert "another motion" in " ".join(found["reasons"])


@needs_shared
# default finds the speed of this drive from rest, and so does fast_lio2 where scan lines are no planes
@pytest.mark.parametrize(
    ("recipe", "settings"),
    [
        ("fast_lio2", ["params.knn.least_width=0"]),
        pytest.param("lio_sam", [], marks=pytest.mark.long),
        pytest.param("loam", [], marks=pytest.mark.long),
    ],
)
def test_a_real_drive_that_is_taken_for_standing_is_lost(recipe, settings):
    sequence = open_sequence(DRIVE)
    found = verdict_of(*tracked(sequence, recipe, [AT_REST, *settings], scans=sequence.scans(0, 20)))
    assert (found["state"], found["since_s"] < 0.3) == ("lost", True)


@pytest.mark.long
def test_an_error_of_more_than_five_percent_of_the_way_is_noticed():
    sequence = road("motorway", 5.0, 0.5, 12)
    settings, results = tracked(sequence, "loam", [AT_REST])
    poses, truth = relative(results, sequence)
    error = np.linalg.norm(poses[-1, :3, 3] - truth[-1, :3, 3])
    assert 0.05 * steps(truth).sum() < error
    assert verdict_of(settings, results)["state"] != "sound"


@pytest.mark.parametrize(
    ("error", "way", "state"),
    [(0.2, 0.5, "sound"), (0.4, 0.5, "doubtful"), (0.4, 12.0, "sound"), (1.1, 40.0, "lost")],
)
def test_how_wrong_a_motion_may_be_depends_on_the_way(error, way, state):
    settings, results = tracked(road("street", 25.0, 0.0, 8), "default")
    seen = replace(results[-1], shown_motion=ShownMotion(error, way, 0.0, 3))
    assert verdict_of(settings, [*results[:-2], seen, seen])["state"] == state


def moved(result, number, step):
    """Return a result as that of another scan, moved along x."""
    pose = result.T_world_imu.copy()
    pose[0, 3] += step
    stamp_ns = result.stamp_ns + number * 100_000_000
    return replace(result, T_world_imu=pose, stamp_ns=stamp_ns, shown_motion=None, motion_is_hidden=None)


@pytest.mark.parametrize(("jump", "state"), [(0.05, "sound"), (0.7, "doubtful")])
def test_a_motion_that_jumps_is_noticed(jump, state):
    settings, results = tracked(road("street", 25.0, 0.0, 8), "default")
    last = results[-1]
    jumping = [moved(last, number, 2.5 * number + jump * (number > 3)) for number in range(1, 12)]
    found = verdict_of(settings, [*results, *jumping])
    assert found["state"] == state
    assert ("jumps" in " ".join(found["reasons"])) == (state != "sound")


def test_unequal_stamps_of_equal_sweeps_are_no_jumps():
    settings, results = tracked(road("street", 25.0, 0.0, 8), "default")
    # as KITTI's stamps are: 0.1, 0.1 and 0.11 s for sweeps of equal length
    late = [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]
    onwards = [
        replace(
            moved(results[-1], number, 2.5 * number),
            stamp_ns=results[-1].stamp_ns + number * 10**8 + late_by * 10**7,
        )
        for number, late_by in enumerate(late[1:], 1)
    ]
    assert verdict_of(settings, [*results, *onwards])["state"] == "sound"


@pytest.mark.parametrize(
    ("recipe", "looks", "is_doubted"),
    [
        pytest.param("loam", 2, True, marks=pytest.mark.long),
        pytest.param("loam", 1, False, marks=pytest.mark.long),
        pytest.param("loam", 0, False, marks=pytest.mark.long),
        ("default", 2, False),
    ],
)
@pytest.mark.parametrize("stays", [False, True])
def test_a_way_along_which_nothing_shows_the_motion_is_doubtful_without_inertial_samples(
    recipe, looks, is_doubted, stays
):
    settings, results = tracked(road("street", 25.0, 0.0, 8), recipe)
    since = (results[-1].stamp_ns - results[0].stamp_ns) * 1e-9
    shown = replace(results[-1], shown_motion=ShownMotion(0.0, 7.5, 0.0, 3), motion_is_hidden=False)
    # a match that stays behind shows no way either
    onwards = [moved(shown, number, 0.0 if stays else 2.5 * number) for number in range(1, 12)]
    for number in range(looks):
        onwards[5 * number] = replace(onwards[5 * number], motion_is_hidden=True)
    found = verdict_of(settings, [*results[:-1], shown, *onwards])
    assert any("nothing upright" in reason for reason in found["reasons"]) == is_doubted
    if is_doubted:
        assert found["since_s"] == pytest.approx(since, abs=1e-3)


@pytest.mark.long
def test_what_stays_behind_in_a_tunnel_is_noticed():
    sequence = SimulatedSequence("tunnel", duration_s=15.0, seed=1)
    settings, results = tracked(sequence, "loam")
    poses, truth = relative(results, sequence)
    error = np.linalg.norm((poses - truth)[:, :3, 3], axis=1)
    assert error[-1] > 1
    found = verdict_of(settings, results)
    assert found["state"] != "sound"
    assert found["since_s"] <= 0.1 * np.argmax(error > 1)


@pytest.mark.parametrize(
    ("seconds", "sigma", "is_doubted"), [(6.0, 0.3, True), (4.0, 0.3, False), (6.0, 0.1, False)]
)
def test_a_direction_that_only_inertial_samples_show_is_doubtful_after_five_seconds(
    seconds, sigma, is_doubted
):
    settings, results = tracked(road("street", 5.0, 0.0, 8), "default")
    output = results[-1].output
    blind = replace(
        output,
        registration=replace(output.registration, degenerate=jnp.arange(6) == 0),
        covariance=jnp.diag(jnp.array([1e-6] * 3 + [sigma**2] * 3 + [1e-6] * 18)),
    )
    onwards = [
        replace(moved(results[-1], number, 0.5 * number), output=blind)
        for number in range(1, round(10 * seconds))
    ]
    found = verdict_of(settings, [*results, *onwards])
    assert any("no scan showed one direction" in reason for reason in found["reasons"]) == is_doubted
    assert (found["state"] != "sound") == is_doubted


@pytest.mark.long
def test_a_drone_over_a_field_warns_before_it_is_a_metre_off():
    """Without inertial samples: with them no recipe is a metre off in this time."""
    sequence = SimulatedSequence("field", duration_s=11.0, seed=1)
    settings, results = tracked(sequence, "loam")
    poses, truth = relative(results, sequence)
    off = np.linalg.norm((poses - truth)[:, :3, 3], axis=1) > 1
    assert off.any()
    assert verdict_of(settings, results[: int(np.argmax(off)) + 1])["state"] != "sound"


@pytest.mark.parametrize(("error", "state"), [(0.4, "sound"), (0.6, "doubtful")])
def test_a_view_that_is_never_precise_has_to_differ_more(error, state):
    settings, results = tracked(road("street", 5.0, 0.0, 8), "default")
    clear = [replace(one, shown_motion=None) for one in results]
    errors = [0.15] * 5 + [error]
    seen = [
        replace(moved(clear[-1], number, 0.5 * number), shown_motion=ShownMotion(off, 2.5, 0.0, 5))
        for number, off in enumerate(errors, 1)
    ]
    assert verdict_of(settings, [*clear, *seen])["state"] == state


def test_plan_views_are_compared_at_any_speed():
    sequence = road("street", 35.0, 0.0, 32)
    settings, _ = settings_for(sequence, recipe_settings("default"))
    truth = sequence.truth()
    check, shown = MotionCheck(), {}
    for index, scan in enumerate(sequence.scans(), 100):
        pose = truth.at(np.array([scan.end_ns])).poses[0] @ sequence.info.T_imu_lidar
        look = check(index, padded(scan, None, settings.config.lidar), pose, lost=False)
        if look.shown is not None:
            shown[index] = look.shown
    late = [one for index, one in shown.items() if index > 120]
    assert late
    assert all(one.error < 0.5 and one.way > 3 for one in late)


@needs_shared
@pytest.mark.parametrize("stands", [True, False])
def test_near_scans_whose_upright_things_are_not_where_the_estimate_puts_them(stands):
    sequence = open_sequence(DRIVE)
    settings, results = tracked(road("street", 25.0, 0.0, 8), "default")
    lidar = settings_for(sequence, recipe_settings("default"))[0].config.lidar
    truth, check, onwards = sequence.truth(), MotionCheck(), []
    for index, scan in enumerate(sequence.scans(0, 40)):
        near = np.linalg.norm(scan.points, axis=1) < 12
        fields = ("points", "time", "ring", "intensity")
        scan = replace(scan, **{name: getattr(scan, name)[near] for name in fields})
        pose = np.eye(4) if stands else truth.at(np.array([scan.end_ns])).poses[0] @ sequence.info.T_imu_lidar
        look = check(index, padded(scan, None, lidar), pose, lost=False)
        onwards.append(
            replace(
                moved(results[-1], index + 1, 0.0),
                shown_motion=look.shown,
                motion_is_hidden=look.is_hidden,
                agreement=look.agreement,
            )
        )
    reasons = " ".join(verdict_of(settings, [*results, *onwards])["reasons"])
    assert ("nothing that stands upright is where" in reasons) == stands


@pytest.mark.parametrize(
    ("agreements", "is_doubted"),
    [
        ([(20, 1), (20, 1)], True),
        ([(20, 1), (19, 1)], False),
        ([(20, 1), (20, 4)], False),
        # what was right before does not hide it
        ([(50, 45), (50, 45), (25, 1), (25, 1)], True),
        # a motion that is shown in between begins anew
        ([(20, 1), None, (20, 1)], False),
    ],
)
def test_upright_things_count_over_several_views(agreements, is_doubted):
    settings, results = tracked(road("street", 25.0, 0.0, 8), "default")
    onwards = [moved(results[-1], number, 2.5 * number) for number in range(1, len(agreements) + 1)]
    for number, one in enumerate(agreements):
        if one is None:
            onwards[number] = replace(onwards[number], shown_motion=ShownMotion(0.0, 7.5, 0.0, 3))
        else:
            onwards[number] = replace(onwards[number], motion_is_hidden=True, agreement=Agreement(*one))
    reasons = " ".join(verdict_of(settings, [*results, *onwards])["reasons"])
    assert ("nothing that stands upright is where" in reasons) == is_doubted


LONG = [pytest.param(name, marks=pytest.mark.long) for name in ("lio_sam", "loam")]


@pytest.mark.parametrize("recipe", ["default", "fast_lio2", *LONG])
def test_a_right_start_is_sound(recipe):
    found = verdict_of(*tracked(road("street", 25.0, 0.0, 8), recipe))
    assert found == {"state": "sound", "since_s": None, "reasons": []}
    assert in_words(found) == "sound"


def test_summary_metrics_and_report_state_the_verdict(tmp_path, capsys):
    drive, out = str(tmp_path / "drive"), tmp_path / "run"
    assert main(["sim", "street", "--sensor", "vlp16", "--duration", "2", "--seed", "1", "--out", drive]) == 0
    assert main(["run", drive, "--out", str(out), "--set", "config.output.recording=false"]) == 0
    assert "verdict    sound" in capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["verdict"] == {"state": "sound", "since_s": None, "reasons": []}
    assert "verdict" in (out / "report.html").read_text()


def drives_on(results, count, **changes):
    """Return results and ``count`` more, at the same speed; each change is a function of the number."""
    last = replace(results[-1], felt_motion=None)
    for number in range(1, count + 1):
        here = {name: change(number) for name, change in changes.items()}
        yield replace(moved(last, number, 0.5 * number), **here)


@pytest.mark.parametrize(("error", "is_doubted"), [(0.25, False), (0.4, True)])
def test_another_motion_than_the_felt_one_is_noticed_at_once(error, is_doubted):
    settings, results = tracked(road("street", 5.0, 0.0, 8), "default")

    def felt(number):
        return FeltMotion(np.array([0.0, 0.0, error if number > 8 else 0.02]), results[0].stamp_ns)

    found = verdict_of(settings, [*results, *drives_on(results, 10, felt_motion=felt)])
    assert (found["state"] != "sound") == is_doubted
    if is_doubted:
        assert found["since_s"] == pytest.approx(0.7 + 0.9, abs=0.01)
        assert "upwards or downwards" in found["reasons"][0]
        assert "lift" in found["reasons"][0]


@pytest.mark.parametrize(
    ("before", "after", "is_doubted"),
    [(0.3, 8.0, True), (0.3, 4.0, False), (6.0, 14.0, False)],
    ids=["raised", "not by much", "always high"],
)
def test_innovations_that_rise_over_their_own_level_are_noticed(before, after, is_doubted):
    settings, results = tracked(road("street", 5.0, 0.0, 8), "default")
    output = results[-1].output

    def measured(number):
        nis = before if number <= 45 else after
        return replace(output, nis=jnp.float64(6 * nis), nis_dof=jnp.int32(6))

    found = verdict_of(settings, [*results[:1], *drives_on(results, 65, output=measured)])
    assert any("contradict" in reason for reason in found["reasons"]) == is_doubted


def test_a_run_whose_scans_match_nothing_is_lost():
    settings, results = tracked(road("street", 5.0, 0.0, 8), "default")
    output = results[-1].output
    nothing = replace(output, registration=replace(output.registration, matches=jnp.int32(0)))
    found = verdict_of(settings, [*results, *drives_on(results, 12, output=lambda number: nothing)])
    assert (found["state"], found["since_s"]) == ("lost", pytest.approx(0.7))


@pytest.mark.parametrize(
    ("sigma", "has_imu", "is_doubted"), [(0.2, False, True), (0.1, False, False), (0.2, True, False)]
)
def test_without_inertial_samples_a_hidden_direction_is_doubtful_earlier(sigma, has_imu, is_doubted):
    settings, results = tracked(road("street", 5.0, 0.0, 8), "default")
    output = results[-1].output
    blind = replace(
        output,
        registration=replace(output.registration, degenerate=jnp.arange(6) == 0),
        covariance=jnp.diag(jnp.array([1e-6] * 3 + [sigma**2] * 3 + [1e-6] * 18)),
    )
    onwards = drives_on(results, 17, output=lambda number: blind, has_imu=lambda number: has_imu)
    found = verdict_of(settings, [*results, *onwards])
    assert (found["state"] != "sound") == is_doubted
    if is_doubted:
        assert found["since_s"] == pytest.approx(0.7 + 1.6, abs=0.01)
        assert "no inertial samples bridge it" in found["reasons"][0]


@pytest.mark.parametrize(
    "case", ["upwards", "along, hidden", "along, not looked at", "along, shown", "dropped"]
)
def test_a_motion_that_noise_alone_may_show_is_doubtful(case):
    settings, results = tracked(road("street", 5.0, 0.0, 8), "default")
    output = results[-1].output
    assert output.shown_by_noise.shape == (6, 3)
    axis = 0 if case.startswith("along") else 2

    def blind(number):
        is_dropped = case == "dropped" or (case == "dropped later" and number > 1)
        dropped = (jnp.arange(6) == 0) & is_dropped
        return replace(
            output,
            shown_by_noise=jnp.zeros((6, 3)).at[0, axis].set(1.0),
            registration=replace(output.registration, degenerate=dropped),
        )

    hidden = {"along, hidden": True, "along, shown": False}.get(case)
    shown = ShownMotion(0.02, 0.5, 0.0, 5) if case == "along, shown" else None
    onwards = []
    for result in drives_on(results, 12, output=blind):
        pose = result.T_world_imu.copy()
        pose[2, 3] += 0.05 * (len(onwards) + 1) * (axis == 2)
        onwards.append(
            replace(result, T_world_imu=pose, motion_is_hidden=hidden, shown_motion=shown, felt_motion=None)
        )
    found = verdict_of(settings, [*results, *onwards])
    is_doubted = case in ("upwards", "along, hidden", "dropped later")
    assert (found["state"] != "sound") == is_doubted
    if is_doubted:
        assert "no scan shows" in found["reasons"][0]
        assert ("upwards or downwards" in found["reasons"][0]) == (axis == 2)
        assert found["since_s"] == pytest.approx(0.7 + (0.6 if axis == 2 else 0.1), abs=0.01)


def test_between_smooth_walls_a_wrong_height_is_doubted_before_it_is_half_a_metre_off():
    sequence = lift_without_floor(0)
    settings, results = tracked(sequence, "default", scans=list(sequence.scans(0, 28)))
    poses, truth = relative(results, sequence)
    error = np.linalg.norm((poses - truth)[:, :3, 3], axis=1)
    assert error.max() > 0.3
    found = verdict_of(settings, results[: 1 + int(np.argmax(error > 0.5)) or None])
    assert found["state"] == "doubtful"
    assert "upwards or downwards" in found["reasons"][0]
    assert "no scan shows" in found["reasons"][0]
