import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.data.trajectory import Trajectory, read_kitti_poses
from lio_jax.evaluation.trajectory_error import absolute_error, align, relative_error
from tests.evaluation.scenes import stamped, straight_drive, transform, winding_drive
from tests.shared_data import SHARED_DATA, needs_shared


@needs_shared
def test_reproduces_the_printed_ate_and_rpe_of_kitti_00():
    folder = SHARED_DATA / "kiss_icp_kitti_00"
    estimate = stamped(read_kitti_poses(folder / "00_poses_kitti.txt"))
    reference = stamped(read_kitti_poses(folder / "00_gt_kitti.txt"))
    ate = absolute_error(estimate, reference, align(estimate.poses, reference.poses))
    # ape_stats.txt, rpe_stats.txt and result_metrics.log beside the poses.
    assert (ate.rmse, ate.mean, ate.max) == pytest.approx((3.515636, 3.022194, 9.785913), abs=1e-6)
    assert f"{ate.rotation_rmse:.3f}" == "0.019"
    rpe = relative_error(estimate, reference)
    assert (rpe.rmse, rpe.mean, rpe.max) == pytest.approx((0.034055, 0.026666, 0.316732), abs=1e-6)
    assert rpe.samples == 4540


def test_equals_evo_used_directly():
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    generator = np.random.default_rng(3)
    reference = winding_drive(200)
    noise = [
        transform(tuple(generator.normal(scale=0.01, size=3)), tuple(generator.normal(scale=0.3, size=3)))
        for _ in range(200)
    ]
    estimate = transform((0.1, 0.0, 2.0), (5.0, 1.0, 0.0)) @ reference @ np.stack(noise)
    truth, aligned = PosePath3D(poses_se3=list(reference)), PosePath3D(poses_se3=list(estimate))
    aligned.align(truth)
    expected = []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad):
        ape = metrics.APE(relation)
        ape.process_data((truth, aligned))
        expected += [
            ape.get_statistic(getattr(metrics.StatisticsType, name)) for name in ("rmse", "mean", "max")
        ]
    ate = absolute_error(stamped(estimate), stamped(reference), align(estimate, reference))
    ours = (ate.rmse, ate.mean, ate.max, ate.rotation_rmse, ate.rotation_mean, ate.rotation_max)
    assert ours == pytest.approx(expected, rel=1e-9)


def test_relative_error_of_a_step_too_long_by_a_tenth():
    reference = straight_drive(11, 1.0)
    estimate = straight_drive(11, 1.1)
    rpe = relative_error(stamped(estimate), stamped(reference))
    assert (rpe.rmse, rpe.mean, rpe.max) == pytest.approx((0.1, 0.1, 0.1))
    assert rpe.rotation_max == pytest.approx(0.0, abs=1e-9)
    assert rpe.samples == 10


def test_relative_rotation_by_hand():
    reference = straight_drive(21, 1.0)
    turning = Rotation.from_euler("x", 0.02 * np.arange(21)[:, None]).as_matrix()
    estimate = reference.copy()
    estimate[:, :3, :3] = turning
    rpe = relative_error(stamped(estimate), stamped(reference))
    assert rpe.rotation_mean == pytest.approx(0.02, rel=1e-6)
    assert rpe.rotation_max == pytest.approx(0.02, rel=1e-6)


def test_relative_error_per_distance_chooses_pairs_along_the_reference():
    reference = straight_drive(101, 1.0)
    estimate = straight_drive(101, 1.2)
    rpe = relative_error(stamped(estimate), stamped(reference), 10.0, "m")
    assert rpe.samples == 10
    assert rpe.mean == pytest.approx(2.0)


def test_single_pose_has_no_relative_error():
    assert relative_error(stamped(np.eye(4)[None]), stamped(np.eye(4)[None])) is None


def test_standing_vehicle_has_no_pair_by_distance():
    still = stamped(np.tile(np.eye(4), (10, 1, 1)))
    assert relative_error(still, still, 10.0, "m") is None


def test_single_pose_has_no_absolute_error():
    pose = Trajectory(np.array([0]), transform((0.1, 0.2, 0.3), (1.0, 2.0, 3.0))[None])
    ate = absolute_error(pose, pose, align(pose.poses, pose.poses))
    assert (ate.rmse, ate.rotation_max) == pytest.approx((0.0, 0.0), abs=1e-7)


def test_evo_neither_prints_nor_needs_a_home_folder(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    home.chmod(0o500)
    code = (
        "from tests.evaluation.scenes import stamped, winding_drive\n"
        "from lio_jax.evaluation.evaluate import evaluate\n"
        "evaluate(stamped(winding_drive()), stamped(winding_drive()), (10.0,))\n"
    )
    environment = {**os.environ, "HOME": str(home), "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(home.iterdir()) == []
