"""Write the registered clouds of a run: each scan's compensated points in world, as its pose was found.

A recipe compensates only the points that it matches or adds to its map. The others are compensated in the
same way here, after the step and apart from its program.

FAST-LIO2 publishes them as /cloud_registered and saves them under pcd_save. The poses are those of the
odometry at the scan's own time: a correction of the back end that comes later does not move a file.
"""

import math
import re
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Float32
from numpy.typing import NDArray

from lio_jax.core.files import aside_of
from lio_jax.core.geometry import dot3, rotation_matrix
from lio_jax.core.types import ImuBatch, NavState, Scan
from lio_jax.core.xla import programs
from lio_jax.imu.path import deskew_along
from lio_jax.imu.strapdown import path_along
from lio_jax.lidar.deskew import deskew_constant_velocity
from lio_jax.recipes.params import RecipeParams
from lio_jax.run.map_file import XYZ, write_cloud
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.run.track import ScanResult
from lio_jax.settings.settings import Settings, recipe_of

FOLDER = "clouds"
MATCHED = "_matched"
"""Ends the names of the files of matched points."""
_SPOOL = re.compile(rf"\.\d{{6,}}({MATCHED})?\.[0-9a-f]{{8}}\.pcd")
_OURS = re.compile(rf"\d{{6,}}({MATCHED})?\.pcd|{_SPOOL.pattern}")
_WAITING = 4
"""Number of scans that may wait to be written; beyond that the run waits."""
_AT_ONCE = 1 << 18
"""Number of points that are copied at once from the file in which they are collected."""


class Leg(eqx.Module):
    """The states between which the motion within a sweep is known: those at its own end and at one before."""

    start: NavState
    end: NavState
    interval: Float[Array, ""]
    """Time between the two, s; 0 where only one scan has a pose."""
    first: Bool[Array, ""]
    """The sweep ends at ``start`` instead: no scan before it had a pose, and the next one shows the turn."""


def placed_scan(
    compensates: bool,
    params: RecipeParams,
    nav: NavState,
    T_matched: jaxlie.SE3,
    leg: Leg,
    scan: Scan,
    imu: ImuBatch | None,
) -> tuple[Float32[Array, "n 3"], Bool[Array, " n"]]:
    """Return all points of a scan, m in world, and which of them are finite and within the range limits.

    With inertial samples, the motion within the sweep is that from the last scan's state along the samples,
    seen from the sweep's end, and the end lies at the scan's own pose: FAST-LIO2's backward propagation.
    Without samples, the velocity is that of the state and the angular rate the mean one since the last scan.

    Args:
        compensates: whether the motion within the sweep is compensated; static.
        params: of the recipe, for the range limits and the corrections of the points.
        nav: state at the scan's end.
        T_matched: T_world_lidar of the scan match, where points without compensation lie.
        leg: from the last scan to this one.
        scan: padded sweep, its coordinates as they were recorded.
        imu: samples that cover the scan; None: there are none.
    """
    squared_range = dot3(scan.points, scan.points)
    near, far = params.lidar.min_range.astype(jnp.float32), params.lidar.max_range.astype(jnp.float32)
    mask = scan.mask & (squared_range > near**2) & (squared_range < far**2)
    points = params.lidar.corrected(jnp.where(mask[:, None], scan.points, 0.0), scan.ring)
    if compensates:
        points = _at_the_end(points, nav, leg, scan, imu)
    T_world_lidar = nav.T_world_imu @ nav.T_imu_lidar if compensates else T_matched
    turned = points @ rotation_matrix(T_world_lidar.rotation()).astype(points.dtype).T
    world = turned.astype(nav.velocity.dtype) + T_world_lidar.translation()
    return world.astype(jnp.float32), mask & jnp.all(jnp.isfinite(world), -1)


def _at_the_end(
    points: Float[Array, "n 3"], nav: NavState, leg: Leg, scan: Scan, imu: ImuBatch | None
) -> Float[Array, "n 3"]:
    """Return points in the lidar frame of the scan's end, m; arguments as of :func:`placed_scan`."""
    dtype = nav.velocity.dtype
    end, interval = scan.duration.astype(dtype), leg.interval.astype(dtype)
    if imu is not None:
        path = path_along(leg.start, imu, jnp.where(leg.first, 0.0, end - interval), end)
        return deskew_along(path, nav.T_imu_lidar, points, scan.time)
    known = interval > 0
    turn = (leg.start.T_world_imu.rotation().inverse() @ leg.end.T_world_imu.rotation()).log()
    rate = jnp.where(known, turn / jnp.where(known, interval, 1.0), 0.0)
    velocity = nav.T_world_imu.rotation().inverse() @ nav.velocity
    twist = nav.T_imu_lidar.inverse().adjoint() @ jnp.concatenate([velocity, rate])
    return deskew_constant_velocity(points, scan.time - scan.duration, twist)


class ScanClouds(Sink):
    """Writes clouds/NNNNNN.pcd: the points of the scans from number NNNNNN of the recording on.

    Where the output says which points were matched, NNNNNN_matched.pcd holds these: FAST-LIO2's
    /cloud_effected.
    """

    def __init__(self, folder: Path, settings: Settings, start: int = 0) -> None:
        """Begin a folder of clouds; a thread places and writes the points.

        Args:
            folder: of the run.
            settings: of the run; ``config.output.clouds`` is not "none".
            start: number of the first scan in the recording.
        """
        self._folder = folder / FOLDER
        self._folder.mkdir(exist_ok=True)
        output = settings.run.output
        self._all = output.clouds == "all"
        self._clouds = _Files(self._folder, "", output.clouds_interval, start)
        self._matched = _Files(self._folder, MATCHED, output.clouds_interval, start)
        self._error: Exception | None = None
        self._params = settings.params()
        self._place = programs(placed_scan, recipe_of(settings).compensates)
        self._last: ScanResult | None = None
        self._opening: ScanResult | None = None
        self._fields: tuple[str, ...] = ()
        self._writer = ThreadPoolExecutor(1, "clouds")
        self._pending: deque[Future[None]] = deque()

    def take(self, result: ScanResult) -> None:
        """Hand a scan to the writing thread; an error of that thread ends the run here."""
        fed = result.fed
        assert fed is not None
        # a scan before the first one that can begin a map has no pose
        if not fed.usable:
            return
        if self._last is None:
            self._opening = result
        else:
            self._open(result)
            self._submit(result, self._last, result)
        self._last = result

    def finish(self, run: RunResult) -> None:
        """Complete the last file, and say how many there are."""
        self._open(None)
        while self._pending:
            self._pending.popleft().result()
        self._writer.submit(self._complete).result()
        run.metrics["clouds"] = {"files": self._clouds.files, "points": self._clouds.points}

    def close(self) -> None:
        """End the thread; a file that was not completed leaves nothing."""
        self._writer.shutdown(cancel_futures=True)
        self._clouds.close()
        self._matched.close()
        with suppress(OSError):  # the folder holds clouds
            self._folder.rmdir()

    def _open(self, second: ScanResult | None) -> None:
        """Submit the first scan: only the second one shows how it turned."""
        if self._opening is not None:
            opening, self._opening = self._opening, None
            self._submit(opening, opening, second or opening)

    def _submit(self, result: ScanResult, start: ScanResult, end: ScanResult) -> None:
        while self._pending and (len(self._pending) >= _WAITING or self._pending[0].done()):
            self._pending.popleft().result()
        self._pending.append(self._writer.submit(self._add, result, start, end))

    def _add(self, result: ScanResult, start: ScanResult, end: ScanResult) -> None:
        # a file that lacks a scan must not be completed by a later one
        if self._error is not None:
            raise self._error
        try:
            output = result.output
            if np.isfinite(result.T_world_imu).all():
                rows = (
                    self._all_points(result, start, end) if self._all else _those(output, output.points_mask)
                )
                self._clouds.add(result.index, rows, self._fields if self._all else XYZ)
                if output.matched is not None:
                    self._matched.add(result.index, _those(output, output.matched), XYZ)
        except Exception as error:
            self._error = error
            raise

    def _complete(self) -> None:
        if self._error is None:
            self._clouds.complete()
            self._matched.complete()

    def _all_points(self, result: ScanResult, start: ScanResult, end: ScanResult) -> NDArray[np.float32]:
        """Return the points of a scan, a column for each field, m in world."""
        output, fed = result.output, result.fed
        assert fed is not None
        interval = np.float32((end.stamp_ns - start.stamp_ns) * 1e-9)
        leg = Leg(start.nav, end.nav, jnp.array(interval), jnp.array(result is start))
        T_matched = output.registration.T_world_lidar
        points, mask = self._place(self._params, result.nav, T_matched, leg, fed.scan, fed.imu)
        kept, intensity = np.asarray(mask), np.asarray(fed.scan.intensity)
        if not self._fields:
            self._fields = (*XYZ, "intensity") if intensity[kept].any() else XYZ
        columns = [np.asarray(points)[kept], intensity[kept, None]][: len(self._fields) - 2]
        return np.concatenate(columns, axis=1, dtype=np.float32)


def _those(output: Any, mask: Any) -> NDArray[np.float32]:
    """Return the points of an output that a mask marks, (n, 3) m in world."""
    points = np.asarray(output.points)[np.asarray(mask)]
    return (points + np.asarray(output.origin)).astype(np.float32)


class _Files:
    """The files of one kind of points, one after the other."""

    def __init__(self, folder: Path, ending: str, interval: int, start: int) -> None:
        self._folder, self._ending, self._interval, self._start = folder, ending, interval, start
        self._file: _OneFile | None = None
        self.files = self.points = 0

    def add(self, index: int, rows: NDArray[np.float32], fields: tuple[str, ...]) -> None:
        """Add a scan's rows; files before it are completed."""
        if self._file is not None and index >= self._file.beyond:
            self.complete()
        if not len(rows):
            return
        if self._file is None:
            first = index - index % self._interval if self._interval else 0
            beyond = first + self._interval if self._interval else math.inf
            name = f"{self._start + first:06d}{self._ending}.pcd"
            self._file = _OneFile(self._folder / name, beyond, fields)
        self._file.append(rows)

    def complete(self) -> None:
        if self._file is not None:
            self._file.write()
            self.files += 1
            self.points += self._file.count
            self.close()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


class _OneFile:
    """Collects points beside a PCD until their number is known, which a PCD states first."""

    def __init__(self, path: Path, beyond: float, fields: tuple[str, ...]) -> None:
        """Begin a file that takes the scans before the one of index ``beyond``."""
        self._path, self.beyond, self._fields = path, beyond, fields
        self._aside = aside_of(path)
        self._spool: BinaryIO = self._aside.open("w+b")
        self.count = 0

    def append(self, rows: NDArray[np.float32]) -> None:
        self._spool.write(np.ascontiguousarray(rows, "<f4").tobytes())
        self.count += len(rows)

    def write(self) -> None:
        self._spool.seek(0)
        write_cloud(self._path, self._collected(), self.count, self._fields)

    def close(self) -> None:
        with suppress(OSError):  # a full disk, met before: what is in the buffer is given up
            self._spool.close()
        self._aside.unlink(missing_ok=True)

    def _collected(self) -> Iterator[NDArray[np.float32]]:
        columns = len(self._fields)
        while values := self._spool.read(4 * columns * _AT_ONCE):
            yield np.frombuffer(values, "<f4").reshape(-1, columns)


def remove_clouds(run_folder: Path, unfinished_only: bool = False) -> None:
    """Remove the clouds of an earlier run, and nothing else.

    Args:
        run_folder: folder of the run.
        unfinished_only: remove only what a killed run had not completed.
    """
    folder = run_folder / FOLDER
    if not folder.is_dir() or folder.is_symlink():
        return
    ours = _SPOOL if unfinished_only else _OURS
    for entry in folder.iterdir():
        if ours.fullmatch(entry.name):
            entry.unlink()
    with suppress(OSError):  # the folder holds completed clouds, or files of others
        folder.rmdir()
