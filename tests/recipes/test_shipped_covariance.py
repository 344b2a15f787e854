"""The covariance by shipped settings, against the errors of simulated drives."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.evaluation.trajectory_error import nees
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from tests.run.roads import road, tracked

_SETTLED = 10
LIDAR_ONLY = ["config.imu.use=false"]


def errors_and_covariances(sequence, results):
    """Return errors of pose and velocity (n, 9) and their covariances, in the world of the first scan."""
    stamps = np.array([item.stamp_ns for item in results])
    motion, moment = sequence.truth(), 10_000_000
    inside = stamps + moment <= motion.stamp_ns[-1]
    results, stamps = [item for item, kept in zip(results, inside, strict=True) if kept], stamps[inside]
    true, after, before = (motion.at(stamps + shift).poses for shift in (0, moment, -moment))
    velocity = (after[:, :3, 3] - before[:, :3, 3]) / (2e-9 * moment)
    T_estimate_truth = results[0].T_world_imu @ np.linalg.inv(true[0])
    poses = np.stack([item.T_world_imu for item in results])
    off = np.linalg.inv(poses) @ T_estimate_truth @ true
    turn = Rotation.from_matrix(off[:, :3, :3]).as_rotvec()
    missed = velocity @ T_estimate_truth[:3, :3].T - np.stack([item.nav.velocity for item in results])
    missed = np.einsum("nji,nj->ni", poses[:, :3, :3], missed)
    covariances = np.stack([np.asarray(item.output.covariance)[:9, :9] for item in results])
    return np.concatenate([turn, off[:, :3, 3], missed], 1), covariances


def normalised(sequences, recipe, overrides=()):
    """Return NEES per degree of freedom of pose and velocity, the mean over drives."""
    found = []
    for sequence in sequences:
        errors, covariances = errors_and_covariances(sequence, tracked(sequence, recipe, overrides)[1])
        for part in (slice(0, 6), slice(6, 9)):
            values = nees(errors[_SETTLED:, part], covariances[_SETTLED:, part, part])
            found.append(values.mean() / (part.stop - part.start))
    return np.mean(np.reshape(found, (-1, 2)), 0)


@cache
def streets():
    return [
        SimulatedSequence(
            "street", duration_s=12.0, beams=32, columns=512, imu=ImuModel(), standstill_s=0.5, seed=seed
        )
        for seed in (3, 4)
    ]


@pytest.mark.long
def test_errors_of_a_drive_that_begins_at_speed_are_as_large_as_default_says():
    pose, velocity = normalised([road("city", 10.0, 0.1, 60, seed) for seed in (3, 4)], "default")
    assert 0.25 < pose < 4
    assert 0.25 < velocity < 4


@cache
def sixteen_beams():
    return [SimulatedSequence("city", "vlp16", duration_s=12.0, imu=ImuModel(), seed=seed) for seed in (3, 4)]


@pytest.mark.long
def test_the_strips_that_few_beams_sweep_over_a_surface_leave_the_pose_as_good_as_its_covariance_says():
    pose, velocity = normalised(sixteen_beams(), "default")
    assert 0.25 < pose < 4
    assert 0.25 < velocity < 4


@pytest.mark.long
def test_strips_taken_for_planes_confirm_a_drift_that_the_covariance_does_not_know():
    shipped, _ = normalised(sixteen_beams(), "default")
    with_strips, _ = normalised(sixteen_beams(), "default", ["params.registration.least_width=0"])
    assert with_strips > 2 * shipped
    assert with_strips > 1.5


@pytest.mark.long
@pytest.mark.parametrize(("recipe", "overrides"), [("default", LIDAR_ONLY), ("fast_lio2", [])])
def test_errors_in_a_street_are_as_large_as_the_covariance_says(recipe, overrides):
    pose, velocity = normalised(streets(), recipe, overrides)
    assert 0.25 < pose < 4
    assert 0.25 < velocity < 4


@pytest.mark.long
def test_a_map_that_is_taken_for_exact_leaves_the_pose_far_too_sure():
    as_fast_lio2 = ["config.fast_lio2.exact_map=true", "params.knn.least_width=0"]
    pose, _ = normalised(streets()[:1], "fast_lio2", as_fast_lio2)
    assert pose > 4


@pytest.mark.long
@pytest.mark.parametrize(("recipe", "overrides"), [("default", LIDAR_ONLY), ("loam", [])])
def test_without_inertial_samples_pose_and_velocity_have_a_covariance(recipe, overrides):
    results = tracked(streets()[0], recipe, overrides)[1]
    covariances = np.stack([np.asarray(item.output.covariance) for item in results])
    assert not covariances[0, :6].any()
    assert np.linalg.eigvalsh(covariances[1:, :9, :9]).min() > 0
    assert not covariances[:, 9:].any()
    assert not covariances[:, :, 9:].any()
    # nothing brings the drive back to where it began
    sigma = np.sqrt(np.trace(covariances[:, 3:6, 3:6], axis1=1, axis2=2))
    assert np.median(sigma[10:40]) < np.median(sigma[-30:])
