"""The tightly coupled recipe on simulated recordings whose truth and noise are known."""

import re
from dataclasses import dataclass
from functools import cache

import jax
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.error_state import EXTRINSIC_ROTATION, EXTRINSIC_TRANSLATION, TIME_OFFSET
from lio_jax.evaluation.trajectory_error import nees
from lio_jax.recipes.default import Default
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.run import settings_for
from lio_jax.run.scan_inputs import OFFSET_MARGIN_S, ImuFeed
from lio_jax.run.track import ScanResult, pose_matrix, track
from lio_jax.settings.settings import Settings, with_extrinsics, with_overrides
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence

SMALL = [
    "config.lidar.buckets=[4096]",
    "config.imu.buckets=[64]",
    "config.imu.registration_points=1024",
    "config.imu.insertion_points=4096",
    "config.map.capacity=32768",
]
CALIBRATING = [
    "params.initial.extrinsic_rotation_sigma=0.1",
    "params.initial.extrinsic_translation_sigma=0.1",
    "params.initial.time_offset_sigma=0.02",
]


@cache
def compiled() -> CompiledStep:
    """Return one step for all tests: they differ in parameters alone."""
    return CompiledStep(with_overrides(Settings(), SMALL))


@cache
def recording(world: str, seconds: float, moving_start: bool = False):
    sequence = SimulatedSequence(
        world, duration_s=seconds, beams=16, columns=256, imu=ImuModel(), moving_start=moving_start
    )
    return sequence, tuple(sequence.scans()), sequence.imu()


@dataclass
class Drive:
    """Estimates and truth at the scans' ends."""

    tracked: list[ScanResult]
    poses: np.ndarray
    truth: np.ndarray

    @property
    def ate(self) -> float:
        """Root mean square position error after the best rigid alignment, m."""
        estimate, truth = (poses[:, :3, 3] for poses in (self.poses, self.truth))
        rotation, _ = Rotation.align_vectors(truth - truth.mean(0), estimate - estimate.mean(0))
        errors = rotation.apply(estimate - estimate.mean(0)) - (truth - truth.mean(0))
        return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))

    @property
    def covariance(self) -> np.ndarray:
        """(n, 24, 24)."""
        return np.stack([np.asarray(item.output.covariance) for item in self.tracked])


def drive(world, seconds, sets=(), *, inertial=True, moving_start=False, T_imu_lidar=None) -> Drive:
    sequence, scans, imu = recording(world, seconds, moving_start)
    extrinsic = sequence.info.T_imu_lidar if T_imu_lidar is None else T_imu_lidar
    settings = with_overrides(with_extrinsics(Settings(), extrinsic, "test"), [*SMALL, *sets])
    step = compiled()
    programs = len(step.init_programs) + len(step.step_programs)
    step.params = settings.params()
    values = settings.values
    margin = OFFSET_MARGIN_S if values["initial"]["time_offset_sigma"] else 0.0
    feed = ImuFeed(imu, (64,), values["extrinsics"]["time_offset"], margin) if inertial else None
    tracked = list(track(settings, scans, feed, step))
    compiled_now = len(step.init_programs) + len(step.step_programs)
    assert compiled_now <= max(programs, 3) + 3, "a parameter compiled a program of its own"
    stamps = np.array([item.stamp_ns for item in tracked])
    return Drive(
        tracked,
        np.stack([item.T_world_imu for item in tracked]),
        sequence.poses((stamps - scans[0].stamp_ns) * 1e-9),
    )


@pytest.mark.long
def test_inertial_samples_hold_a_fast_handheld_walk():
    near = [f"{path}={value}" for path, value in Default.near_values.items()]
    coupled, alone = drive("office", 12.0, near), drive("office", 12.0, near, inertial=False)
    assert not any(item.output.lost for item in coupled.tracked)
    assert coupled.ate < 0.01
    assert coupled.ate < 0.5 * alone.ate


def test_the_map_is_written_where_it_lies():
    """A copy of it takes longer than the match where the map is large."""
    drive("city", 2.0)
    for program in compiled().step_programs._programs.values():
        text = program.as_text()
        assert "f32[32768,10]" in text
        assert not re.search(r"= f32\[32768,10\]\S* copy\(", text)


def test_a_moving_start_is_found():
    moving = drive("city", 6.0, moving_start=True)
    truth = np.linalg.norm(moving.truth[-1, :3, 3] - moving.truth[-2, :3, 3]) / 0.1
    assert truth > 3
    assert np.linalg.norm(moving.tracked[-1].nav.velocity) == pytest.approx(truth, abs=0.1)
    assert moving.ate < 0.08


def test_full_speed_is_known_from_the_second_scan_on():
    moving = drive("street", 2.0, moving_start=True)
    speeds = np.linalg.norm(np.diff(moving.truth[:, :3, 3], axis=0), axis=1) / 0.1
    assert speeds[0] > 4
    found = [np.linalg.norm(item.nav.velocity) for item in moving.tracked[2:]]
    np.testing.assert_allclose(found, speeds[1:], atol=0.4)
    sigma = np.sqrt(np.diagonal(moving.covariance[2])[6:9]).max()
    assert np.linalg.norm(found[0] - speeds[1]) < 4 * sigma
    assert moving.ate < 0.03


TRUE_NOISE = [
    *(f"params.imu.{name}={getattr(ImuModel, name)}" for name in ("gyro_noise", "accel_noise")),
    "params.lidar.range_sigma=0.024",
    "params.registration.information_scale=0.34",
]
"""Values of the simulated IMU; the last two as tuning without truth finds them on such streets."""


def test_the_pose_is_as_wrong_as_it_says():
    sequence = SimulatedSequence("street", duration_s=8.0, beams=32, columns=512, imu=ImuModel())
    settings, _ = settings_for(sequence, with_overrides(Settings(), TRUE_NOISE))
    imu = ImuFeed(sequence.imu(), settings.config.imu.buckets, 0.0, 0.0)
    tracked = list(track(settings, sequence.scans(), imu))
    stamps = np.array([item.stamp_ns for item in tracked])
    truth = sequence.truth().at(stamps).poses
    poses = np.stack([item.T_world_imu for item in tracked])[: len(truth)]
    covariance = np.stack([np.asarray(item.output.covariance) for item in tracked])[: len(truth)]
    off = np.linalg.inv(poses) @ poses[0] @ np.linalg.inv(truth[0]) @ truth
    error = np.concatenate([Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]], axis=1)
    normalised = nees(error[20:], covariance[20:, :6, :6]) / 6
    # one drive, whose errors hang together: far from a chi-square's band, but no factor of ten
    assert 0.3 < normalised.mean() < 2.5


def wrong(T: np.ndarray) -> np.ndarray:
    """Return an extrinsic that is off by 5 degrees and 10 cm."""
    T = T.copy()
    T[:3, :3] @= Rotation.from_rotvec(np.radians(5) * np.array([0.6, -0.5, 0.6245])).as_matrix()
    T[:3, 3] += 0.1 * np.array([0.6, 0.64, -0.48])
    return T


def extrinsic_error(item: ScanResult, T: np.ndarray) -> tuple[float, float]:
    """Return degrees and metres between an estimated and the true T_imu_lidar."""
    found = pose_matrix(item.nav.T_imu_lidar.wxyz_xyz)
    turn = Rotation.from_matrix(T[:3, :3].T @ found[:3, :3]).magnitude()
    return float(np.degrees(turn)), float(np.linalg.norm(found[:3, 3] - T[:3, 3]))


def test_a_wrong_calibration_is_found_while_the_motion_excites_it():
    true = recording("office", 20.0)[0].info.T_imu_lidar
    shaken = drive(
        "office", 20.0, [*CALIBRATING, "params.extrinsics.time_offset=0.02"], T_imu_lidar=wrong(true)
    )
    degrees, metres = extrinsic_error(shaken.tracked[-1], true)
    assert degrees < 0.3
    assert metres < 0.02
    assert abs(float(shaken.tracked[-1].nav.time_offset)) < 1e-3
    sigma = np.sqrt(np.diagonal(shaken.covariance[-1]))
    assert np.degrees(sigma[EXTRINSIC_ROTATION]).max() < 0.3
    assert sigma[TIME_OFFSET] < 2e-3


def test_a_calibration_that_nothing_excites_stays_put():
    true = recording("street", 1.2)[0].info.T_imu_lidar
    still = drive("street", 1.2, CALIBRATING, T_imu_lidar=wrong(true))
    degrees, metres = extrinsic_error(still.tracked[-1], wrong(true))
    assert degrees < 0.2
    assert metres < 0.01
    sigma = np.sqrt(np.diagonal(still.covariance[-1]))
    assert sigma[EXTRINSIC_ROTATION].min() > 0.05
    assert sigma[EXTRINSIC_TRANSLATION].min() > 0.05


def test_a_frozen_calibration_does_not_move_by_a_bit():
    walked = drive("office", 12.0)
    first, last = (walked.tracked[i].nav for i in (0, -1))
    np.testing.assert_array_equal(first.T_imu_lidar.wxyz_xyz, last.T_imu_lidar.wxyz_xyz)
    assert first.time_offset == last.time_offset
    assert not walked.covariance[-1][EXTRINSIC_ROTATION].any()


def test_a_tunnel_is_flagged_and_uncertain_along_its_axis_alone():
    through = drive("tunnel", 22.0)
    x = through.truth[:, 0, 3]
    inside = x > 110
    assert inside.sum() > 50
    weak = np.array([int(item.output.registration.degenerate.sum()) for item in through.tracked])
    assert np.mean(weak[inside] == 1) > 0.95
    R = through.poses[:, :3, :3]
    sigma = np.sqrt(np.diagonal(R @ through.covariance[:, 3:6, 3:6] @ R.transpose(0, 2, 1), axis1=1, axis2=2))
    assert (np.diff(sigma[inside, 0]) > 0).all()
    # within the map that was built on the way; from the world the heading of the first metres adds to it
    in_map = np.stack([np.asarray(item.output.evidence.pose_covariance) for item in through.tracked])
    sigma_in_map = np.sqrt(np.diagonal(in_map[:, 3:, 3:], axis1=1, axis2=2))
    assert sigma_in_map[-1, 0] > 10 * sigma_in_map[inside, 1:].max()
    truth = through.poses[0] @ np.linalg.inv(through.truth[0]) @ through.truth
    off = np.abs(through.poses - truth)[inside, :3, 3]
    assert (off < 3 * sigma[inside]).all()


def test_velocity_biases_and_gravity_are_the_true_ones_within_their_uncertainty():
    sequence, _, _ = recording("office", 20.0)
    walked = drive("office", 20.0)
    biases = sequence.truth_arrays()
    last, sigma = walked.tracked[-1], np.sqrt(np.diagonal(walked.covariance[-1]))
    gyro = np.asarray(last.nav.gyro_bias) - biases["gyro_bias"][-1]
    accel = np.asarray(last.nav.accel_bias) - biases["accel_bias"][-1]
    assert (np.abs(gyro) < 4 * sigma[9:12]).all()
    assert (np.abs(accel) < 4 * sigma[12:15]).all()
    up = last.nav.T_world_imu.wxyz_xyz
    force = jaxlie.SE3(jax.numpy.asarray(up)).rotation().inverse() @ -last.nav.gravity
    truth = walked.truth[-1, :3, :3].T @ np.array([0, 0, 9.80665])
    tilt = np.linalg.norm(np.cross(force, truth)) / np.linalg.norm(truth) ** 2
    assert tilt < 4 * np.sqrt(np.sum(sigma[15:17] ** 2) + np.sum(sigma[:3] ** 2)) + 1e-3
