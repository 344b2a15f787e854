"""Read a trajectory from TUM and KITTI text files, run folders, and recordings with truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import read_text
from lio_jax.data.kitti import read_times
from lio_jax.data.trajectory import Trajectory, read_kitti_poses, read_tum

_RUN_TRAJECTORY = "trajectory.tum"


@dataclass(frozen=True)
class LoadedTrajectory:
    """A trajectory, and whether its stamps are known."""

    trajectory: Trajectory
    stamped: bool
    """Whether the file holds stamps; if False, ``stamp_ns`` only counts 0, 1, 2 and so on."""
    source: str
    """File or recording from which it was read, for messages."""


def load_trajectory(path: Path) -> LoadedTrajectory:
    """Read the trajectory that ``path`` holds.

    A run folder gives its trajectory.tum, a recording its ground truth (both T_world_imu). A text file is
    read as TUM (8 numbers a line) or as KITTI poses (12). KITTI poses get their stamps from a times.txt in
    the same folder, from ``../sequences/NN/times.txt``, or from the trajectory.tum of the same run.

    Raises:
        LioJaxError: nothing is there, or it holds no trajectory.
    """
    if not path.exists():
        raise LioJaxError(
            f"{path}: there is no such file or folder; give a trajectory, a run folder or a recording."
        )
    if path.is_dir() and (path / _RUN_TRAJECTORY).is_file():
        path = path / _RUN_TRAJECTORY
    if path.is_dir() or path.suffix in _bag_suffixes():
        return _recorded_truth(path)
    columns = _columns(path)
    if columns == 8:
        return LoadedTrajectory(read_tum(path), True, str(path))
    if columns == 12:
        return _kitti(path)
    raise LioJaxError(
        f"{path}: {columns} numbers in its first line; a TUM trajectory has 8 (t x y z qx qy qz qw), "
        "a KITTI pose file 12."
    )


def _columns(path: Path) -> int:
    for line in read_text(path, "give a TUM or KITTI pose file").splitlines():
        words = line.replace(",", " ").split("#")[0].split()
        if words:
            return len(words)
    raise LioJaxError(f"{path}: holds no poses; the run that should have written it has probably failed.")


def _kitti(path: Path) -> LoadedTrajectory:
    poses = read_kitti_poses(path)
    stamps = _kitti_stamps(path, len(poses))
    if stamps is None:
        return LoadedTrajectory(Trajectory(np.arange(len(poses), dtype=np.int64), poses), False, str(path))
    return LoadedTrajectory(Trajectory(stamps, poses), True, str(path))


def _kitti_stamps(path: Path, count: int) -> NDArray[np.int64] | None:
    with_stamps = path.with_name(_RUN_TRAJECTORY)
    if path.name == "trajectory_kitti.txt" and with_stamps.is_file():
        stamps = read_tum(with_stamps).stamp_ns
        if len(stamps) == count:
            return stamps
    for times in (path.with_name("times.txt"), path.parent.parent / "sequences" / path.stem / "times.txt"):
        if times.is_file():
            stamps = np.array(read_times(times), np.int64)
            if len(stamps) == count and np.all(np.diff(stamps) > 0):
                return stamps
    return None


def _bag_suffixes() -> tuple[str, ...]:
    from lio_jax.data.rosbag import BAG_SUFFIXES

    return BAG_SUFFIXES


def _recorded_truth(path: Path) -> LoadedTrajectory:
    from lio_jax.data.detect import open_sequence

    truth = open_sequence(path).truth()
    if truth is None or len(truth) == 0:
        raise LioJaxError(f"{path}: this recording holds no ground truth; give a trajectory file instead.")
    return LoadedTrajectory(truth, True, str(path))
