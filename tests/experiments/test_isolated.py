"""Systems in processes of their own: what one does to itself does not touch the others."""

from pathlib import Path

import numpy as np
import pytest

from lio_jax.data.native_writer import write_native
from lio_jax.data.sequence import LidarScan
from tests.experiments import bench_path  # noqa: F401

from isolated import Maker, Outcome, run  # isort: skip

SCANS = 6
STEP_NS = 100_000_000
NEVER = -1


def scan(number: int) -> LidarScan:
    points = np.ones((4 + number, 3), np.float32)
    flat = np.zeros(len(points))
    return LidarScan(
        stamp_ns=number * STEP_NS,
        points=points,
        time=flat.astype(np.float32),
        ring=flat.astype(np.int32),
        intensity=flat.astype(np.float32),
        duration=0.1,
    )


def maker(late: bool = False, fails_at: int = NEVER, dies_at: int = NEVER, function: str = "steady") -> Maker:
    return Maker("tests.experiments.dummy_systems", function, (late, fails_at, dies_at))


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Outcome], list[str]]:
    """Return the outcomes of all kinds of systems from one run, because starting processes takes time."""
    path: Path = tmp_path_factory.mktemp("recording") / "short"
    write_native(path, (scan(number) for number in range(SCANS)))
    said: list[str] = []
    makers = {
        "steady": maker(),
        "late": maker(late=True),
        "failing": maker(fails_at=2),
        "dying": maker(dies_at=3),
        "unknown": maker(function="not_there"),
    }
    return run(path, makers, said.append), said


def test_every_scan_has_a_time_a_pose_and_the_stamp_of_its_start(outcomes):
    steady = outcomes[0]["steady"]
    assert len(steady.milliseconds) == len(steady.cpu_milliseconds) == SCANS
    trajectory = steady.trajectory(STEP_NS // 2)
    assert trajectory.stamp_ns.tolist() == [number * STEP_NS + STEP_NS // 2 for number in range(SCANS)]
    assert trajectory.positions[:, 0].tolist() == list(range(SCANS))
    assert not steady.failures
    assert not steady.died


def test_a_system_that_answers_late_keeps_the_scans_its_poses_belong_to(outcomes):
    late = outcomes[0]["late"]
    assert late.scan_stamp_ns == [number * STEP_NS for number in range(SCANS - 2)]
    assert [pose[0, 3] for pose in late.poses] == [2, 3, 4, 5]
    assert len(late.milliseconds) == SCANS


def test_a_failed_scan_is_named_and_the_system_goes_on(outcomes):
    failing = outcomes[0]["failing"]
    assert failing.failures == ["scan 2: ValueError: too few points."]
    assert len(failing.poses) == SCANS - 1
    assert not failing.died


def test_a_crash_is_named_and_keeps_what_there_was(outcomes):
    dying = outcomes[0]["dying"]
    assert "scan 3" in dying.died
    assert "signal 11" in dying.died
    assert len(dying.poses) == 3


def test_a_system_that_cannot_be_built_is_named(outcomes):
    found, said = outcomes
    assert "did not start" in found["unknown"].died
    assert "not_there" in found["unknown"].died
    assert not found["unknown"].poses
    assert [line.split(":")[0] for line in said] == ["unknown", "dying"]


def test_memory_is_each_process_s_own(outcomes):
    steady = outcomes[0]["steady"]
    assert 0 < steady.idle_mb <= steady.peak_mb
