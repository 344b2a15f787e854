"""Faults of the set-up are named during a run, and none where the set-up is right."""

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from lio_jax.cli import main
from lio_jax.run.run import imu_feed, settings_for
from lio_jax.run.set_up_check import SetUpCheck
from lio_jax.run.set_up_fit import Poses, Samples, SetUp, equations, fitted, solved
from lio_jax.run.sinks import RunResult
from lio_jax.run.track import track
from lio_jax.run.verdict import Verdict
from lio_jax.settings.settings import recipe_settings, with_overrides
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from tests.run.roads import road, tracked

GRAVITY = np.array([0.0, 0.0, -9.81])


def angles(time):
    """Return yaw, pitch and roll of a shaken body, rad."""
    yaw = 0.3 * time + 0.4 * np.sin(0.9 * time)
    return np.stack([yaw, 0.1 * np.sin(2.1 * time), 0.08 * np.cos(1.7 * time)], axis=-1)


def places(time):
    """Return its positions, m."""
    return np.stack([3 * np.sin(0.5 * time), 2 * np.cos(0.7 * time), 0.2 * np.sin(1.3 * time)], axis=-1)


def recorded(true: SetUp) -> tuple[list[Poses], Samples]:
    """Return windows of lidar poses and inertial samples, by the motion's finite differences."""
    time, step = np.arange(-0.5, 21.0, 0.005), 1e-4
    attitude = Rotation.from_euler("ZYX", angles(time))
    gyro = (attitude.inv() * Rotation.from_euler("ZYX", angles(time + step))).as_rotvec() / step
    acceleration = (places(time + step) - 2 * places(time) + places(time - step)) / step**2
    accel = attitude.inv().apply(acceleration - GRAVITY)
    # an instant of the lidar's clock is later on the IMU's by the offset
    samples = Samples(time + true.time_offset, gyro, accel)
    scans = np.arange(0.0, 20.01, 0.1)
    body = Rotation.from_euler("ZYX", angles(scans))
    rotations = (body * true.R_imu_lidar).as_matrix()
    positions = places(scans) + body.apply(true.t_imu_lidar)
    parts = scans, rotations, positions
    return [Poses(*(part[one : one + 21] for part in parts)) for one in range(0, 200, 20)], samples


ASSUMED = SetUp(Rotation.from_euler("xyz", [1, -2, 3], degrees=True), np.array([0.2, 0.0, 0.3]))
TRUE = SetUp(
    Rotation.from_euler("xyz", [6, -5, -4], degrees=True), np.array([-0.1, 0.4, 0.2]), time_offset=-0.04
)


def test_the_fit_finds_extrinsic_and_clock_of_an_exact_motion():
    windows, samples = recorded(TRUE)
    found, fit = fitted(windows, samples, ASSUMED, 6)
    assert np.degrees((found.R_imu_lidar.inv() * TRUE.R_imu_lidar).magnitude()) < 0.05
    np.testing.assert_allclose(found.t_imu_lidar, TRUE.t_imu_lidar, atol=0.01)
    assert found.time_offset == pytest.approx(TRUE.time_offset, abs=5e-4)
    assert np.linalg.norm(found.gravity) == pytest.approx(9.81, abs=0.02)
    assert fit.turn_sigma < 1e-3
    assert fit.position_sigma < 2e-3


def test_a_right_set_up_gains_nothing_by_a_fit():
    windows, samples = recorded(ASSUMED)
    fit = solved([equations(window, samples, ASSUMED) for window in windows], ASSUMED)
    assert np.degrees(np.linalg.norm(fit.step[:3])) < 0.05
    assert abs(fit.step[6]) < 5e-4
    assert np.linalg.norm(fit.step[13:]) < 0.01


def test_a_straight_way_does_not_determine_the_lever_arm():
    windows, samples = recorded(ASSUMED)
    time = samples.seconds
    still = Samples(time, 0 * samples.gyro, np.tile(-GRAVITY, (len(time), 1)))
    straight = [
        Poses(one.seconds, np.tile(np.eye(3), (21, 1, 1)), one.seconds[:, None] * [5.0, 0, 0])
        for one in windows
    ]
    fit = solved([equations(window, still, ASSUMED) for window in straight], ASSUMED)
    assert (np.sqrt(np.diag(fit.covariance))[13:] > 1.0).all()


@cache
def drive() -> tuple[SimulatedSequence, list]:
    sequence = SimulatedSequence("city", duration_s=14.0, seed=3, imu=ImuModel())
    return sequence, list(sequence.scans())


def checked(
    recipe="default", overrides=(), change=lambda imu: imu, turn=None, move=(0.0, 0.0, 0.0), seconds=9.5
):
    """Return the faults and the verdict of a run whose samples or extrinsic were changed."""
    sequence, scans = drive()
    scans = scans[: round(10 * seconds)]
    T_imu_lidar = sequence.info.T_imu_lidar.copy()
    if turn is not None:
        T_imu_lidar[:3, :3] = T_imu_lidar[:3, :3] @ turn.as_matrix()
    T_imu_lidar[:3, 3] += move
    faulty = SimpleNamespace(
        info=replace(sequence.info, T_imu_lidar=T_imu_lidar),
        scans=sequence.scans,
        imu=lambda: change(sequence.imu()),
        warnings_so_far=(),
    )
    settings, _ = settings_for(faulty, with_overrides(recipe_settings(recipe), overrides))
    imu, _ = imu_feed(faulty, settings)
    said = []
    check, judge, run = SetUpCheck(settings, imu.samples, said.append), Verdict(settings), RunResult()
    for result in track(settings, scans, imu):
        check.take(result)
        judge.take(result)
    check.finish(run)
    judge.finish(run)
    assert said == [fault["sentence"] for fault in run.metrics["set_up"]]
    return run.metrics["set_up"], run.metrics["verdict"]


RECIPES = ["default", "fast_lio2", pytest.param("lio_sam", marks=pytest.mark.long)]
SECONDS = {"lio_sam": 14.0}
"""Time that shows the fault, where it is longer: the scans whose window has not converged do not count."""


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_right_set_up_is_not_doubted(recipe):
    faults, verdict = checked(recipe, seconds=14.0)
    assert faults == []
    assert verdict["state"] == "sound"


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_wrong_rotation_is_named_with_its_size(recipe):
    turn = Rotation.from_euler("z", 6, degrees=True)
    (fault,), verdict = checked(recipe, turn=turn, seconds=SECONDS.get(recipe, 9.5))
    assert fault["kind"] == "rotation"
    assert "wrong by 6 deg" in fault["sentence"] or "wrong by 5 deg" in fault["sentence"]
    assert verdict["state"] == "doubtful"
    assert fault["sentence"] in verdict["reasons"]


def test_a_wrong_translation_is_named_with_its_size():
    (fault,), _ = checked(move=(0.6, 0.0, 0.0), seconds=14.0)
    assert fault["kind"] == "translation"
    size = float(fault["sentence"].split("wrong by ")[1].split(" m")[0])
    assert size == pytest.approx(0.6, abs=0.1)


@pytest.mark.parametrize(
    ("recipe", "late"),
    [
        ("default", 0.05),
        ("default", -0.03),
        ("fast_lio2", 0.03),
        pytest.param("lio_sam", -0.05, marks=pytest.mark.long),
    ],
)
def test_another_clock_is_named_with_its_offset(recipe, late):
    (fault,), _ = checked(
        recipe,
        change=lambda imu: replace(imu, stamp_ns=imu.stamp_ns + round(late * 1e9)),
        seconds=SECONDS.get(recipe, 9.5),
    )
    assert fault["kind"] == "clock"
    offset = float(fault["sentence"].split("params.extrinsics.time_offset=")[1].rstrip("."))
    assert offset == pytest.approx(late, abs=0.015)


def test_an_offset_that_is_set_is_no_fault():
    late = 0.05
    faults, _ = checked(
        overrides=[f"params.extrinsics.time_offset={late}"],
        change=lambda imu: replace(imu, stamp_ns=imu.stamp_ns + round(late * 1e9)),
    )
    assert faults == []


@pytest.mark.parametrize("recipe", RECIPES)
def test_an_axis_of_the_gyroscope_with_the_wrong_sign_is_named(recipe):
    (fault,), verdict = checked(
        recipe, change=lambda imu: replace(imu, gyro=imu.gyro * [1, 1, -1]), seconds=14.0
    )
    assert fault["kind"] == "axes"
    assert verdict["state"] != "sound"


def scan_result(number, duration=0.1, interval_ns=100_000_000, beams=None, moved=0.0, shown=None):
    pose = np.eye(4)
    pose[0, 3] = moved * number
    stamp_ns = 5_000_000_000 + number * interval_ns
    return SimpleNamespace(
        stamp_ns=stamp_ns, duration=duration, beams=beams, T_world_imu=pose, shown_motion=shown, index=number
    )


def faults_of(settings, **fields):
    check = SetUpCheck(settings, None)
    for number in range(40):
        check.take(scan_result(number, **fields))
    return [fault.kind for fault in check.faults.values()]


def test_sweeps_that_last_longer_than_the_time_between_scans_are_named():
    loam = recipe_settings("loam")
    assert faults_of(loam, duration=0.2) == ["period"]
    assert faults_of(loam, duration=0.1) == []
    assert faults_of(loam, duration=0.0) == []
    # a recording in which every second scan was left out is none
    assert faults_of(loam, duration=0.1, interval_ns=200_000_000) == []
    given = with_overrides(loam, ["config.data.scan_period=0.05"])
    assert faults_of(given, duration=0.05) == ["period"]


@pytest.mark.parametrize(
    ("beams", "moved", "named"), [(8, 1.0, True), (8, 0.1, False), (16, 3.0, False), (0, 3.0, False)]
)
def test_few_beams_at_speed_are_named(beams, moved, named):
    assert faults_of(recipe_settings("loam"), beams=beams, moved=moved) == ["beams"] * named


@pytest.mark.long
def test_a_run_states_the_fault_in_its_folder(tmp_path, capsys):
    source, out = tmp_path / "drive", tmp_path / "run"
    command = ["sim", "city", "--sensor", "vlp16", "--duration", "12", "--seed", "3", "--out", str(source)]
    assert main(command) == 0
    late = ["--set", "params.extrinsics.time_offset=0.06", "--set", "config.output.recording=false"]
    assert main(["run", str(source), "--out", str(out), *late]) == 0
    printed = "".join(capsys.readouterr())
    metrics = json.loads((out / "metrics.json").read_text())
    (fault,) = metrics["set_up"]
    assert fault["kind"] == "clock"
    assert fault["sentence"] in printed
    assert metrics["verdict"]["state"] == "doubtful"
    assert yaml.safe_load((out / "config.yaml").read_text())["params"]["extrinsics"]["time_offset"] == 0.06


def test_a_bend_at_speed_is_no_fault_of_the_gyroscope():
    # the accelerometers' mean leans by 50 degrees there
    sequence = road("street", 25.0, 0.5, 30)
    settings, results = tracked(sequence, "default")
    imu, _ = imu_feed(sequence, settings)
    check = SetUpCheck(settings, imu.samples)
    for one in results:
        check.take(one)
    assert sum(one.shown_motion is not None for one in results) >= 4
    assert not check.faults
