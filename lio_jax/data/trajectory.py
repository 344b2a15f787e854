"""Time-stamped poses on the host, and the two text formats in which the field exchanges them."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import read_text
from lio_jax.core.timestamps import ns_to_seconds, seconds_to_ns


@dataclass(frozen=True)
class Trajectory:
    """Poses T_world_body at int64 nanosecond stamps."""

    stamp_ns: NDArray[np.int64]
    """Stamp of each pose, (n,) ns, ascending."""
    poses: NDArray[np.float64]
    """Poses T_world_body, (n, 4, 4), m."""

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def positions(self) -> NDArray[np.float64]:
        """Return the positions in the world frame, (n, 3) m."""
        return self.poses[:, :3, 3]

    @property
    def quaternions(self) -> NDArray[np.float64]:
        """Return the rotations world from body as quaternions xyzw, (n, 4)."""
        return Rotation.from_matrix(self.poses[:, :3, :3]).as_quat()

    def finite(self) -> "Trajectory":
        """Return the poses without those that hold NaN or infinity: estimates that failed."""
        kept = np.isfinite(self.poses).all(axis=(1, 2))
        return self if kept.all() else Trajectory(self.stamp_ns[kept], self.poses[kept])

    def times_body(self, T_body_other: NDArray[np.float64]) -> "Trajectory":
        """Return T_world_other = T_world_body T_body_other."""
        return Trajectory(self.stamp_ns, self.poses @ T_body_other)

    def at(self, stamp_ns: NDArray[np.int64]) -> "Trajectory":
        """Interpolate at the stamps that are within the trajectory's span; leave out the others.

        Rotations by slerp, positions linearly between neighbouring poses.
        """
        stamp_ns = np.asarray(stamp_ns, np.int64)
        inside = stamp_ns[(stamp_ns >= self.stamp_ns[0]) & (stamp_ns <= self.stamp_ns[-1])]
        if len(self) == 1 or inside.size == 0:
            return Trajectory(inside, np.repeat(self.poses[:1], inside.size, axis=0))
        # only the poses around the stamps: a query for one moment must not cost time for the whole trajectory
        first = min(np.searchsorted(self.stamp_ns, inside.min(), "right") - 1, len(self) - 2)
        last = max(np.searchsorted(self.stamp_ns, inside.max(), "left"), first + 1)
        near = slice(first, last + 1)
        origin = self.stamp_ns[first]
        knots = (self.stamp_ns[near] - origin) * 1e-9
        query = (inside - origin) * 1e-9
        poses = np.tile(np.eye(4), (inside.size, 1, 1))
        poses[:, :3, :3] = Slerp(knots, Rotation.from_matrix(self.poses[near, :3, :3]))(query).as_matrix()
        for axis in range(3):
            poses[:, axis, 3] = np.interp(query, knots, self.poses[near, axis, 3])
        return Trajectory(inside, poses)


def pose_matrices(positions: NDArray[np.float64], quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Assemble (n, 4, 4) poses from (n, 3) positions and (n, 4) xyzw quaternions; NaN gives NaN."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    finite = np.isfinite(quaternions).all(axis=1)
    poses[~finite, :3, :3] = np.nan
    poses[finite, :3, :3] = Rotation.from_quat(quaternions[finite]).as_matrix()
    poses[:, :3, 3] = positions
    return poses


_ROTATION_ERROR = 0.01
"""Largest error of R R^T of a rotation in a file, where few decimals may be written."""
_QUATERNION_LENGTHS = (0.1, 10.0)
"""Lengths of quaternions that are normalised; another one is no rotation."""


def are_rigid(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each (3, 4) or (4, 4) matrix is finite and a rotation with a translation, (n,)."""
    finite = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    rotations = np.where(finite[:, None, None], matrices[:, :3, :3], 0.0)
    # an entry of a rotation is at most one; the square of a larger one may overflow
    small = (np.abs(rotations) < 2).all(axis=(1, 2))
    rotations[~small] = 0.0
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    return np.asarray((error < _ROTATION_ERROR) & (np.linalg.det(rotations) > 0))


def read_tum(path: Path) -> Trajectory:
    """Read lines ``t x y z qx qy qz qw`` (s, m, xyzw).

    Poses with NaN or infinity are returned as they are: estimates that failed.

    Raises:
        LioJaxError: a line does not hold eight numbers, or time does not ascend.
    """
    stamps, rows = [], []
    lines = read_text(path, "give a TUM file, lines of 't x y z qx qy qz qw'").splitlines()
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split("#")[0].split()
        if not words:
            continue
        try:
            if len(words) != 8:
                raise ValueError
            stamps.append(seconds_to_ns(words[0]))
            rows.append([float(word) for word in words[1:]])
            length = math.hypot(*rows[-1][3:])
            # a pose of NaN is an estimate that failed
            if length < _QUATERNION_LENGTHS[0] or _QUATERNION_LENGTHS[1] < length < math.inf:
                raise ValueError
        except (ValueError, OverflowError):
            raise LioJaxError(
                f"{path}: line {number} is not 't x y z qx qy qz qw' (eight numbers, no zero quaternion); "
                "fix or remove it."
            ) from None
    if not rows:
        raise LioJaxError(
            f"{path}: holds no poses; a TUM trajectory has one line 't x y z qx qy qz qw' each."
        )
    values = np.array(rows)
    return _checked(path, Trajectory(np.array(stamps, np.int64), pose_matrices(values[:, :3], values[:, 3:])))


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write ``t x y z qx qy qz qw`` with 9 decimals of time."""
    path.write_text(tum_lines(trajectory))


def tum_lines(trajectory: Trajectory) -> str:
    """Return the lines of :func:`write_tum`, each with its line break."""
    lines = (
        f"{ns_to_seconds(int(stamp))} " + " ".join(f"{value:.9f}" for value in (*position, *quaternion))
        for stamp, position, quaternion in zip(
            trajectory.stamp_ns, trajectory.positions, trajectory.quaternions, strict=True
        )
    )
    return "".join(f"{line}\n" for line in lines)


def read_kitti_poses(path: Path) -> NDArray[np.float64]:
    """Read (n, 4, 4) poses from lines of twelve numbers (3x4, row major).

    Poses with NaN or infinity are returned as they are: estimates that failed.

    Raises:
        LioJaxError: a line does not hold twelve numbers, or its 3x3 part is no rotation.
    """
    text = read_text(path, "give a KITTI pose file, lines of 12 numbers")
    lines = [line for line in text.splitlines() if line.split("#")[0].strip()]
    if not lines:
        raise LioJaxError(f"{path}: holds no poses; a KITTI pose file has one line of 12 numbers each.")
    try:
        rows = np.loadtxt(lines, ndmin=2)
    except ValueError as error:
        raise LioJaxError(f"{path}: not a KITTI pose file ({error}); each line holds 12 numbers.") from None
    if rows.shape[1] != 12:
        raise LioJaxError(
            f"{path}: {rows.shape[1]} numbers a line; a KITTI pose file holds 12 (3x4, row major)."
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :] = rows.reshape(-1, 3, 4)
    wrong = np.isfinite(rows).all(axis=1) & ~are_rigid(poses)
    if wrong.any():
        raise LioJaxError(
            f"{path}: pose {int(np.argmax(wrong)) + 1} is no rotation with a translation (the rows of its "
            "3x3 part must be orthogonal and of length 1); fix or remove its line."
        )
    return poses


def write_kitti_poses(path: Path, poses: NDArray[np.float64]) -> None:
    """Write (n, 4, 4) poses as lines of twelve numbers."""
    np.savetxt(path, poses[:, :3, :].reshape(-1, 12), fmt="%.9e")


def _checked(path: Path, trajectory: Trajectory) -> Trajectory:
    if np.any(np.diff(trajectory.stamp_ns) <= 0):
        line = int(np.argmax(np.diff(trajectory.stamp_ns) <= 0)) + 2
        raise LioJaxError(
            f"{path}: time does not ascend at pose {line}; sort the file and remove duplicates."
        )
    return trajectory
