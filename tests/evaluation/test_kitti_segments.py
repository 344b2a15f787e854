import itertools

import numpy as np
import pytest

from lio_jax.data.trajectory import read_kitti_poses
from lio_jax.evaluation.kitti_segments import kitti_errors, kitti_short_errors, segment_errors
from tests.evaluation.scenes import straight_drive, transform, winding_drive
from tests.shared_data import SHARED_DATA, needs_shared

KISS_ICP_00 = SHARED_DATA / "kiss_icp_kitti_00"


def devkit(estimate, reference, lengths, step):
    """The benchmark's loops, written out: one segment at a time, arccos of the trace."""
    travelled = [0.0]
    for before, after in itertools.pairwise(reference):
        travelled.append(travelled[-1] + np.linalg.norm(after[:3, 3] - before[:3, 3]))
    translations, rotations = [], []
    for first in range(0, len(reference), step):
        for length in lengths:
            last = next(
                (i for i in range(first, len(travelled)) if travelled[i] > travelled[first] + length), None
            )
            if last is None:
                continue
            true = np.linalg.inv(reference[first]) @ reference[last]
            ours = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(ours) @ true
            translations.append(np.linalg.norm(error[:3, 3]) / length)
            rotations.append(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)) / length)
    return 100 * np.mean(translations), np.degrees(np.mean(rotations)), len(translations)


@needs_shared
def test_reproduces_the_printed_numbers_of_kitti_00():
    estimate = read_kitti_poses(KISS_ICP_00 / "00_poses_kitti.txt")
    reference = read_kitti_poses(KISS_ICP_00 / "00_gt_kitti.txt")
    errors = kitti_errors(estimate, reference)
    assert f"{errors.translation_percent:.3f}" == "0.527"
    assert f"{errors.rotation_deg_per_m:.3f}" == "0.002"


@needs_shared
def test_agrees_with_another_implementation_on_kitti_00():
    metrics = pytest.importorskip("kiss_icp.metrics", reason="kiss-icp (extra 'bench') is not installed")
    estimate = read_kitti_poses(KISS_ICP_00 / "00_poses_kitti.txt")
    reference = read_kitti_poses(KISS_ICP_00 / "00_gt_kitti.txt")
    percent, deg_per_m = metrics.sequence_error(reference, estimate)
    errors = kitti_errors(estimate, reference)
    assert errors.translation_percent == pytest.approx(percent, rel=1e-6)
    # That implementation accumulates in single precision and takes arccos near one.
    assert errors.rotation_deg_per_m == pytest.approx(deg_per_m, rel=2e-3)


def test_equals_the_benchmark_loops_on_a_drifting_drive():
    reference = winding_drive(300)
    drift = np.stack(
        [transform((1e-4 * i, 2e-4 * i, -5e-4 * i), (0.01 * i, 0.0, 0.002 * i)) for i in range(300)]
    )
    estimate = reference @ drift
    errors = segment_errors(estimate, reference, (20.0, 50.0, 100.0), 7)
    percent, deg_per_m, segments = devkit(estimate, reference, (20.0, 50.0, 100.0), 7)
    assert errors.translation_percent == pytest.approx(percent, rel=1e-9)
    assert errors.rotation_deg_per_m == pytest.approx(deg_per_m, rel=1e-6)
    assert errors.segments == segments


def test_one_percent_of_scale_error_is_one_percent_of_drift():
    reference = straight_drive(1001, 1.0)
    estimate = reference.copy()
    estimate[:, :3, 3] *= 1.01
    errors = kitti_errors(estimate, reference)
    # A segment ends at the first frame BEYOND the length: 101 m for 100 m with frames 1 m apart.
    beyond = np.mean(
        np.concatenate([[(n + 1) / n] * len(range(0, 1000 - n, 10)) for n in range(100, 801, 100)])
    )
    assert errors.translation_percent == pytest.approx(1.0 * beyond, rel=1e-9)
    assert errors.rotation_deg_per_m == pytest.approx(0.0, abs=1e-12)


def test_constant_turn_error_gives_its_rate():
    reference = straight_drive(400, 0.5)
    turning = np.stack([transform((0.0, 0.0, np.radians(0.01) * 0.5 * i), (0, 0, 0)) for i in range(400)])
    errors = segment_errors(reference @ turning, reference, (50.0,), 10)
    # 50 m end at the first frame beyond, 50.5 m: 0.01 deg/m over 50.5 m, divided by 50 m.
    assert errors.rotation_deg_per_m == pytest.approx(0.01 * 50.5 / 50.0, rel=1e-9)


def test_does_not_depend_on_the_world_frame():
    reference = winding_drive(300)
    estimate = reference @ np.stack([transform((0, 0, 1e-3 * i), (0, 0, 0)) for i in range(300)])
    moved = transform((0.3, -1.0, 2.0), (100.0, 5.0, -3.0)) @ estimate
    here, there = kitti_short_errors(estimate, reference), kitti_short_errors(moved, reference)
    assert there.translation_percent == pytest.approx(here.translation_percent, rel=1e-9)
    assert there.rotation_deg_per_m == pytest.approx(here.rotation_deg_per_m, rel=1e-9)


def test_tiny_rotation_is_not_lost_to_rounding():
    reference = straight_drive(60, 1.0)
    turning = np.stack([transform((0.0, 1e-9 * i, 0.0), (0, 0, 0)) for i in range(60)])
    errors = segment_errors(reference @ turning, reference, (10.0,), 1)
    assert errors.rotation_deg_per_m == pytest.approx(np.degrees(1e-9 * 11.0) / 10.0, rel=1e-3)


def test_path_shorter_than_any_segment_has_no_error():
    poses = straight_drive(9, 1.0)
    assert kitti_errors(poses, poses) is None
    assert kitti_short_errors(poses, poses) is None


def test_short_form_serves_a_path_the_benchmark_does_not():
    poses = straight_drive(50, 1.0)
    assert kitti_errors(poses, poses) is None
    # 49 m: lengths 10, 20, 30 and 40 m fit, from every frame that leaves room for length + 1 m.
    assert kitti_short_errors(poses, poses).segments == sum(49 - length for length in (10, 20, 30, 40))


def test_one_pose_has_no_error():
    assert kitti_short_errors(np.eye(4)[None], np.eye(4)[None]) is None
