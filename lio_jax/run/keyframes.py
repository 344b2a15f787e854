"""Pick keyframes from a trajectory, chain them into a pose graph, and keep their clouds on disk."""

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import array_of, atomic_path, read_arrays
from lio_jax.core.geometry import carried
from lio_jax.loops.edge_noise import odometry_covariance, stated_growth
from lio_jax.loops.keyframe import Keyframe
from lio_jax.pose_graph.g2o import G2oEdge
from lio_jax.run.failures import BridgedOutage, only_leaves_open
from lio_jax.run.track import ScanResult
from lio_jax.settings.settings import Settings

_LOOSE = np.diag([1e-2] * 3 + [1.0] * 3)
"""Covariance where it is unknown: standard deviations of 0.1 rad and 1 m."""


class KeyframePicker:
    """Choose as keyframes the scans that moved or turned enough since the last keyframe."""

    def __init__(self, settings: Settings) -> None:
        sigmas, output = settings.values["backend"], settings.run.output
        self._distance, self._angle = output.keyframe_distance, output.keyframe_angle
        self._sigmas = tuple(
            sigmas[f"odometry_{name}"] for name in ("rotation_sigma", "translation_sigma", "scale")
        )
        self._last: Keyframe | None = None
        self._last_covariance: NDArray[np.float64] | None = None
        self._failed = False
        self.stamps_ns: list[int] = []
        """Stamps of the keyframes so far, ns."""
        self.pieces: list[int] = []
        """Indices of the keyframes with which a new piece of map begins after an outage."""

    def __call__(self, tracked: ScanResult) -> Keyframe | None:
        """Return the scan as a keyframe, or None if it is not one.

        The covariance between two keyframes is what the estimator's covariance grows by, and the variances of
        ``params.backend``. It is large if a scan between them failed, and that of the pose where a new piece
        of map begins. A scan that leaves directions open did not fail: the estimator's covariance grows along
        these directions. A scan that was not matched gives a pose without points: where the points are is not
        known.
        """
        T, outage = tracked.T_world_imu, tracked.outage
        self._failed |= bool(tracked.failure) and not _is_stated(tracked)
        moved = self._last is None or is_keyframe(self._last.T_odom_imu, T, self._distance, self._angle)
        if not np.isfinite(T).all() or not (moved or outage):
            return None
        points, covariance = points_in_imu(tracked), _pose_covariance(tracked)
        stated = None if outage or self._failed else self._stated_since_last(T, covariance)
        unknown = _across(outage) if outage else _LOOSE
        self._last = Keyframe(
            index=0 if self._last is None else self._last.index + 1,
            stamp_ns=tracked.stamp_ns,
            T_odom_imu=T,
            points=points[:0] if bool(tracked.output.lost) and outage is None else points,
            covariance=unknown if stated is None else odometry_covariance(stated, *self._sigmas),
            stated=stated,
            position_error=outage.position if outage else 0.0,
            heading_error=outage.heading if outage else 0.0,
        )
        self._last_covariance, self._failed = covariance, False
        self.stamps_ns.append(tracked.stamp_ns)
        self.pieces += [self._last.index] if outage else []
        return self._last

    def _stated_since_last(
        self, T_odom_imu: NDArray[np.float64], covariance: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """Return what the estimator states of a pose's error since the last keyframe, (6, 6)."""
        before = self._last_covariance
        if self._last is None or before is None or covariance is None:
            return np.zeros((6, 6))
        T_this_last = np.linalg.inv(T_odom_imu) @ self._last.T_odom_imu
        return stated_growth(before, covariance, T_this_last)


def _is_stated(tracked: ScanResult) -> bool:
    """Return whether the covariance of a scan that failed contains the error of its pose."""
    return only_leaves_open(tracked.output) and _pose_covariance(tracked) is not None


def _pose_covariance(tracked: ScanResult) -> NDArray[np.float64] | None:
    """Return the covariance of the pose's right perturbation, (6, 6); None where it is not known."""
    if tracked.output.covariance is None:
        return None
    covariance = np.array(tracked.output.covariance, np.float64)[:6, :6]
    return covariance if np.isfinite(covariance).all() else None


def _across(outage: BridgedOutage) -> NDArray[np.float64]:
    """Return the covariance of the pose across an outage, (6, 6)."""
    if outage.covariance is not None:
        return outage.covariance + _LOOSE
    return np.diag([outage.heading**2] * 3 + [outage.position**2] * 3)


def points_in_imu(tracked: ScanResult) -> NDArray[np.float32]:
    """Return the scan's compensated points, (n, 3) m, in the IMU frame at the scan's end."""
    output, T = tracked.output, tracked.T_world_imu
    # the difference of the origins is taken in double precision; the points count from a near origin
    from_imu = np.asarray(output.points)[np.asarray(output.points_mask)] + (
        np.asarray(output.origin) - T[:3, 3]
    ).astype(np.float32)
    return from_imu @ T[:3, :3].astype(np.float32)


def corner_marks(tracked: ScanResult) -> NDArray[np.bool_] | None:
    """Return which of :func:`points_in_imu` are corners, (n,); None where the recipe does not separate."""
    output = tracked.output
    return None if output.corners is None else np.asarray(output.corners)[np.asarray(output.points_mask)]


def is_keyframe(T_last: NDArray[np.float64], T: NDArray[np.float64], distance: float, angle: float) -> bool:
    """Return whether a (4, 4) pose is further than ``distance`` (m) or ``angle`` (rad) from the last one."""
    moved = np.linalg.inv(T_last) @ T
    turned = np.arccos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1.0, 1.0))
    return bool(np.linalg.norm(moved[:3, 3]) > distance or turned > angle)


def keyframe_indices(poses: NDArray[np.float64], distance: float, angle: float) -> list[int]:
    """Return the indices of poses that moved or turned enough since the last chosen one; the first is chosen.

    Args:
        poses: (n, 4, 4) poses, m.
        distance: least distance between keyframes, m.
        angle: least angle between keyframes, rad.
    """
    chosen = [0]
    for index in range(1, len(poses)):
        if is_keyframe(poses[chosen[-1]], poses[index], distance, angle):
            chosen.append(index)
    return chosen


_SINGULAR = 1e-12
"""Least eigenvalue of a correlation matrix that is inverted."""


def odometry_edges(poses: NDArray[np.float64], covariances: NDArray[np.float64]) -> list[G2oEdge]:
    """Return the edges between consecutive poses, under the assumption of independent errors.

    A relative pose T_i_j = T_i^-1 T_j has the covariance S_j + A S_i A', with A the adjoint of T_j_i. Where a
    covariance is unknown or singular, the edge gets standard deviations of 0.1 rad and 1 m.

    Args:
        poses: (n, 4, 4) poses, m.
        covariances: (n, 6, 6) covariances of the poses' right perturbations, rotation first; NaN where
            unknown.
    """
    edges = []
    for i in range(len(poses) - 1):
        T_i_j = np.linalg.inv(poses[i]) @ poses[i + 1]
        covariance = covariances[i + 1] + carried(covariances[i], np.linalg.inv(T_i_j))
        edges.append(G2oEdge(i, i + 1, T_i_j, np.linalg.inv(covariance if _regular(covariance) else _LOOSE)))
    return edges


def _regular(covariance: NDArray[np.float64]) -> bool:
    """Return whether a covariance is finite and has an inverse."""
    sigma = np.sqrt(np.diagonal(covariance))
    if not (np.isfinite(covariance).all() and (sigma > 0).all()):
        return False
    return bool(np.linalg.eigvalsh(covariance / np.outer(sigma, sigma))[0] > _SINGULAR)


FOLDER = "keyframes"
Part = Literal["whole", "corner", "surface"]

_INDEX = "index.npz"
_OURS = re.compile(r"(\d{6,}|index|\.(\d{6,}|index)\.[0-9a-f]{8})\.npz")


class KeyframeWriter:
    """Write keyframes' clouds during a run, and the keyframes' poses at its end."""

    def __init__(self, run_folder: Path) -> None:
        self._folder = run_folder / FOLDER
        self._folder.mkdir(exist_ok=True)
        self._count = 0

    def append(self, points: NDArray[np.float32], corner: NDArray[np.bool_] | None = None) -> None:
        """Write the next keyframe's cloud.

        Args:
            points: (n, 3) m, in the IMU frame at the keyframe's stamp.
            corner: (n,) which points are corners, where the recipe separates them.
        """
        arrays: dict[str, Any] = {"points": np.asarray(points, np.float32)}
        if corner is not None:
            arrays["corner"] = np.asarray(corner, bool)
        with atomic_path(self._folder / _name(self._count)) as aside:
            np.savez(aside, **arrays)
        self._count += 1

    def finish(
        self,
        stamps_ns: NDArray[np.int64],
        T_world_imu: NDArray[np.float64],
        T_odom_imu: NDArray[np.float64],
    ) -> None:
        """Write the index; it may be written again after further corrections of the poses.

        Args:
            stamps_ns: (k,) stamps of all appended keyframes, ns.
            T_world_imu: (k, 4, 4) corrected poses.
            T_odom_imu: (k, 4, 4) poses of the smooth odometry.

        Raises:
            ValueError: the number of poses differs from the number of clouds.
        """
        shapes = (len(stamps_ns), np.shape(T_world_imu), np.shape(T_odom_imu))
        if shapes != (self._count, (self._count, 4, 4), (self._count, 4, 4)):
            raise ValueError(f"{self._count} keyframes were written; their index has {shapes}")
        with atomic_path(self._folder / _INDEX) as aside:
            np.savez(aside, stamps_ns=stamps_ns, T_world_imu=T_world_imu, T_odom_imu=T_odom_imu)


@dataclass(frozen=True, eq=False)
class StoredKeyframes:
    """The keyframes that a run has written."""

    folder: Path
    stamps_ns: NDArray[np.int64]
    T_world_imu: NDArray[np.float64]
    """Corrected poses, (k, 4, 4)."""
    T_odom_imu: NDArray[np.float64]
    """Poses of the smooth odometry, (k, 4, 4)."""

    def points(self, number: int, part: Part = "whole") -> NDArray[np.float32]:
        """Return the points of one keyframe, (n, 3) m, in its IMU frame.

        Raises:
            LioJaxError: the file is missing or damaged, or does not separate corners from surfaces.
        """
        path = self.folder / _name(number)
        arrays = _arrays(path)
        points, corner = arrays.get("points"), arrays.get("corner")
        if points is None or points.dtype.kind != "f" or points.ndim != 2 or points.shape[1] != 3:
            raise LioJaxError(f"{path}: holds no points (n, 3); run again.")
        if part == "whole":
            return points.astype(np.float32, copy=False)
        if corner is None:
            raise LioJaxError(f"{path}: the recipe separated no corners; take the part 'whole'.")
        if corner.shape != (len(points),):
            raise LioJaxError(f"{path}: {len(points)} points, but {len(corner)} marks of corners; run again.")
        return points[corner == (part == "corner")].astype(np.float32, copy=False)

    def clouds(self, part: Part = "whole") -> Iterator[tuple[NDArray[np.float64], NDArray[np.float32]]]:
        """Yield T_world_imu (4, 4) and points (n, 3) of each keyframe whose pose is finite."""
        for number, T_world_imu in enumerate(self.T_world_imu):
            if np.isfinite(T_world_imu).all():
                yield T_world_imu, self.points(number, part)


def read_keyframes(run_folder: Path) -> StoredKeyframes:
    """Open the keyframes of a run; their clouds are read one by one when needed.

    Raises:
        LioJaxError: there are no keyframes, or their index is missing or damaged.
    """
    folder = run_folder / FOLDER
    if not folder.is_dir():
        raise LioJaxError(f"{folder}: no such folder; the run kept no keyframes.")
    path = folder / _INDEX
    if not path.is_file():
        raise LioJaxError(f"{path}: missing, the run was ended before its poses were known; run again.")
    arrays = _arrays(path)
    names = ("stamps_ns", "T_world_imu", "T_odom_imu")
    if missing := [name for name in names if name not in arrays]:
        raise LioJaxError(f"{path}: lacks {', '.join(missing)}; run again.")
    stamps_ns, T_world_imu, T_odom_imu = (arrays[name] for name in names)
    try:
        count = len(array_of(arrays, "stamps_ns", (None,), "iu"))
        for name in ("T_world_imu", "T_odom_imu"):
            array_of(arrays, name, (None, 4, 4), "f")
    except ValueError as error:
        raise LioJaxError(f"{path}: cannot be read ({error}); run again.") from None
    if not len(T_world_imu) == len(T_odom_imu) == count:
        raise LioJaxError(f"{path}: its stamps and poses differ in number; run again.")
    return StoredKeyframes(folder, stamps_ns, T_world_imu, T_odom_imu)


def remove_keyframes(run_folder: Path, unfinished_only: bool = False) -> None:
    """Remove the keyframes of an earlier run, half-written ones included, and nothing else.

    Args:
        run_folder: folder of the run.
        unfinished_only: keep keyframes with an index: their run was completed.
    """
    folder = run_folder / FOLDER
    if not folder.is_dir() or folder.is_symlink() or (unfinished_only and (folder / _INDEX).exists()):
        return
    for entry in folder.iterdir():
        if _OURS.fullmatch(entry.name):
            entry.unlink()
    with suppress(OSError):  # the folder holds files of others
        folder.rmdir()


def _name(number: int) -> str:
    return f"{number:06d}.npz"


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        return read_arrays(path)
    except FileNotFoundError:
        raise LioJaxError(f"{path}: missing; run again.") from None
    except (OSError, ValueError) as error:
        raise LioJaxError(f"{path}: cannot be read ({error}); run again.") from None
