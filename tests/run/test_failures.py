"""Sentences about a scan's estimate: what went wrong, and what most likely caused it."""

from dataclasses import replace
from types import SimpleNamespace

import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, LOST, NOT_FINITE, ImuBatch
from lio_jax.run.failures import ScanEvidence, failure_of, longest_gap, unobserved_directions
from lio_jax.settings.settings import Settings, recipe_settings, with_overrides

SETTINGS = Settings()
UNTURNED = Rotation.identity()


def pose(rotation: Rotation = UNTURNED) -> jaxlie.SE3:
    return jaxlie.SE3(np.array([*rotation.as_quat(scalar_first=True), 1.0, 2.0, 3.0]))


def nav(**fields) -> SimpleNamespace:
    zeros = {name: np.zeros(3) for name in ("velocity", "gyro_bias", "accel_bias")}
    return SimpleNamespace(T_world_imu=pose(), **(zeros | {k: np.array(v) for k, v in fields.items()}))


def match(missing: tuple[np.ndarray, ...] = (), rotation: Rotation = UNTURNED, **fields):
    """A scan match with points 10 m away that says nothing along world directions (turn, move)."""
    scale = np.repeat([10.0, 1.0], 3)
    information = np.diag(np.full(6, 1e4))
    for direction in missing:
        unit = scale * direction / np.linalg.norm(scale * direction)
        keep = np.eye(6) - np.outer(unit, unit)
        information = keep @ information @ keep
    to_world = np.kron(np.eye(2), rotation.as_matrix())
    values = {
        "T_world_lidar": pose(rotation),
        "information": to_world.T @ (scale[:, None] * information * scale) @ to_world,
        "degenerate": np.arange(6) < len(missing),
        "matches": np.int32(300),
        "rmse": np.array(0.05),
        "iterations": np.int32(4),
        "status": np.int32(CONVERGED),
    }
    return SimpleNamespace(**(values | fields))


def evidence(**fields) -> ScanEvidence:
    usual = ScanEvidence(
        points=1000,
        covered=False,
        nav=nav(),
        registration=match(),
        lost=False,
        nis=6.0,
        since_last_s=0.1,
        imu_gap_s=0.01,
    )
    return replace(usual, **fields)


def said(before: ScanEvidence | None = None, settings: Settings = SETTINGS, **fields) -> str:
    return failure_of(evidence(**fields), before or evidence(), settings)


def test_a_scan_with_too_few_features_says_how_many_it_has() -> None:
    lio_sam = recipe_settings("lio_sam")
    sentence = said(settings=lio_sam, lost=True, registration=match(status=np.int32(LOST)), features=(3, 260))
    assert sentence.startswith(
        "it has 3 corners and 260 surface points, 10 and 100 are needed (params.submap"
    )
    assert "matched" not in sentence


def test_a_good_scan_gives_no_sentence() -> None:
    assert said() == ""
    assert failure_of(evidence(since_last_s=0.0, imu_gap_s=None), None, SETTINGS) == ""


def test_no_points() -> None:
    assert said(points=0, lost=True) == "it holds no points; the pose is the prediction."


def test_too_few_matches_name_a_gap_of_the_samples() -> None:
    lost = match(matches=np.int32(7), status=np.int32(LOST))
    assert said(registration=lost, lost=True) == (
        "7 points matched the map, 50 are needed; the pose is the prediction."
    )
    assert said(registration=lost, lost=True, imu_gap_s=0.5) == (
        "7 points matched the map, 50 are needed (there was no inertial sample for 0.50 s); "
        "the pose is the prediction."
    )


def test_an_update_that_is_not_finite_says_why_and_what_is_kept() -> None:
    nan = match(status=np.int32(NOT_FINITE), information=np.full((6, 6), np.nan))
    assert said(registration=nan, lost=True) == (
        "the update was not finite (the equations of its 300 matches hold NaN or infinity); state and "
        "covariance are the prediction's, the map was not changed."
    )
    assert "the filter's covariance overflowed" in said(
        registration=match(status=np.int32(NOT_FINITE)), lost=True
    )


def test_no_convergence() -> None:
    sentence = said(registration=match(status=np.int32(ITERATION_LIMIT)))
    assert sentence == "registration did not converge in 60 iterations; its last pose was kept."


ALONG_X = np.array([0.0, 0, 0, 1, 0, 0])


def test_an_unobserved_direction_is_named() -> None:
    sentence = said(registration=match((ALONG_X,)), nav=nav(velocity=[3.0, 0, 0]))
    assert sentence == (
        "the scene leaves 1 of 6 directions unobserved (along the motion); there the prediction was kept."
    )


@pytest.mark.parametrize("by", [None, 0.01], ids=["constant velocity", "inertial samples"])
def test_an_outage_says_what_predicted(by: float | None) -> None:
    what = "constant velocity" if by is None else "inertial samples"
    assert said(since_last_s=5.1, imu_gap_s=by) == (
        f"no scan came for 5.10 s before it: {what} predicted the motion."
    )


def test_an_outage_of_both_is_bridged_by_constant_velocity() -> None:
    assert "constant velocity predicted" in said(since_last_s=5.1, imu_gap_s=5.0)


FAST = nav(velocity=[0.0, 48.0, 64.0])


def test_speed_beyond_the_limit_is_said_once() -> None:
    assert said(nav=FAST).startswith("the speed reached 80 m/s, above params.limits.speed=60: ")
    assert said(evidence(nav=FAST), nav=FAST) == ""
    assert said(settings=with_overrides(SETTINGS, ["params.limits.speed=90"]), nav=FAST) == ""


@pytest.mark.parametrize(
    ("cause", "words"),
    [
        ({"imu_gap_s": 0.5}, "there was no inertial sample for 0.50 s"),
        ({"registration": match((ALONG_X,))}, "the scene does not constrain the pose across the motion"),
        ({"nis": 812.3}, "the scan contradicts the prediction (NIS 812, residual 0.05 m, biases"),
        ({"lost": True}, "the scan was not matched"),
        ({}, "no gap, unobserved direction or contradiction (residual 0.05 m) explains it"),
    ],
    ids=["gap", "degenerate", "residual", "lost", "none"],
)
def test_the_cause_is_named(cause: dict, words: str) -> None:
    assert words in said(nav=FAST, **cause)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gyro_bias", "the gyroscope's bias reached 1.5 rad/s, above params.limits.gyro_bias=1: "),
        (
            "accel_bias",
            "the accelerometer's bias reached 1.5 m/s^2, above params.limits.accel_bias=1: ",
        ),
    ],
)
def test_biases_beyond_the_limit_are_said(name: str, words: str) -> None:
    assert said(nav=nav(**{name: [0.0, 1.5, 0.0]}), nis=100.0).startswith(words)


def test_two_things_are_two_sentences() -> None:
    sentence = said(registration=match((ALONG_X,)), nav=FAST)
    assert "the prediction was kept. The speed reached" in sentence


Z = np.array([0.0, 0.0, 1.0])
NOT = np.zeros(3)
MOVING = nav(velocity=[1.0, 1.0, 0.1])
AHEAD, ASIDE = np.array([1.0, 1.0, 0.0]), np.array([-1.0, 1.0, 0.0])


@pytest.mark.parametrize("rotation", [UNTURNED, Rotation.from_euler("zyx", [2.0, 0.4, -0.7])])
@pytest.mark.parametrize(
    ("missing", "words"),
    [
        ([(NOT, AHEAD)], ["along the motion"]),
        ([(NOT, ASIDE)], ["across the motion"]),
        ([(NOT, Z)], ["along the vertical"]),
        ([(Z, NOT)], ["in yaw"]),
        ([(AHEAD, NOT)], ["in roll"]),
        ([(ASIDE, NOT)], ["in pitch"]),
        ([(NOT, [1.0, 0, 0])], ["along (1.00, 0.00, 0.00) in world"]),
        # a plain: any two vectors of the same space mean the same
        (
            [(NOT, [1.0, 0, 0]), (NOT, [0, 1.0, 0]), (Z, NOT)],
            ["along the motion", "across the motion", "in yaw"],
        ),
    ],
)
def test_directions_are_named_whatever_the_mounting(missing: list, words: list, rotation: Rotation) -> None:
    found = match(tuple(np.concatenate([turn, move]) for turn, move in missing), rotation)
    assert unobserved_directions(found, MOVING) == words


def test_at_rest_the_imus_axis_says_what_is_along() -> None:
    turned = nav()
    turned.T_world_imu = pose(Rotation.from_euler("z", 90, degrees=True))
    assert unobserved_directions(match((ALONG_X,)), turned) == ["across the IMU's x axis"]


def test_information_that_is_not_finite_ends_no_run() -> None:
    found = match((ALONG_X,))
    found.information = np.full((6, 6), np.inf)
    assert len(unobserved_directions(found, MOVING)) == 1


def samples(times: list[float]) -> ImuBatch:
    rows = np.zeros((len(times) + 2, 3))
    mask = np.arange(len(rows)) < len(times)
    return ImuBatch(time=np.array([*times, 9.0, 9.0]), gyro=rows, accel=rows, mask=mask)


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([], 0.1),
        ([-0.01, 0.04, 0.08, 0.11], 0.05),
        ([-0.4, 0.08, 0.11], 0.48),
        ([-0.4, -0.01, 0.04, 0.08, 0.5], 0.42),
        ([0.07], 0.07),
        ([-0.4, 0.0, 0.05, 0.1, 0.6], 0.05),
    ],
)
def test_longest_gap_touches_the_span(times: list[float], expected: float) -> None:
    assert longest_gap(samples(times), 0.0, 0.1) == pytest.approx(expected)
