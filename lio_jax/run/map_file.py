"""Point clouds on disk: PCD and PLY files, a map that grows during a run, and a map that is kept in tiles."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import aside_of, atomic_path
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.run.track import ScanResult

CLOUD_ENDINGS = (".pcd", ".ply")


def check_ending(path: Path) -> None:
    """Refuse a file whose ending is not that of a known format.

    Raises:
        UsageError: the ending is unknown.
    """
    if path.suffix.lower() not in CLOUD_ENDINGS:
        raise UsageError(f"{path}: a map's name ends in {' or '.join(CLOUD_ENDINGS)}; choose one of them.")


XYZ = ("x", "y", "z")


def write_cloud(
    path: Path, parts: Iterable[NDArray[np.float32]], count: int, fields: tuple[str, ...] = XYZ
) -> None:
    """Write points, complete or not at all, in binary: PCD or PLY (little endian), by the file's ending.

    Args:
        path: path of the file.
        parts: arrays (n, k) with a column for each field, coordinates in m; they are taken one by one.
        count: total number of points in the parts; both formats state it first.
        fields: names of the k columns.

    Raises:
        UsageError: the file has another ending.
        ValueError: the parts have more points, or fewer.
    """
    check_ending(path)
    with atomic_path(path) as aside, aside.open("wb") as file:
        file.write((_ply_header if path.suffix.lower() == ".ply" else _pcd_header)(count, fields))
        written = sum(_append(file, part) for part in parts)
        if written != count:
            raise ValueError(f"{written} points came where {count} were announced")


def read_cloud(path: Path) -> NDArray[np.float32]:
    """Return the (n, 3) points of a PCD, m.

    Raises:
        LioJaxError: the file cannot be read, or holds no x, y and z.
    """
    from pypcd4 import PointCloud

    try:
        return np.asarray(PointCloud.from_path(path).numpy(("x", "y", "z")), np.float32)
    except Exception as error:  # exceptions of the library, of numpy and of pydantic
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise LioJaxError(f"{path}: cannot be read as a PCD ({reason}); write it again.") from None


def _append(file: BinaryIO, points: NDArray[np.float32]) -> int:
    file.write(np.ascontiguousarray(points, "<f4").tobytes())
    return len(points)


def _pcd_header(count: int, fields: tuple[str, ...]) -> bytes:
    from pypcd4 import Encoding, MetaData

    kind: Literal["F"] = "F"
    described = MetaData(
        fields=fields,
        size=(4,) * len(fields),
        type=(kind,) * len(fields),
        count=(1,) * len(fields),
        points=count,
        width=count,
    )
    return described.compose_header(Encoding.BINARY).encode()


def _ply_header(count: int, fields: tuple[str, ...]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in fields]
    return "\n".join([*lines, "end_header", ""]).encode()


_TILE_M = 40.0
"""Approximate edge of a tile, m: the map is cut along x and y, and a tile holds whole voxels."""
_KEPT = 2_000_000
"""Number of points that are kept in memory before they go to their tiles."""
FARTHEST = 1e6
"""Points farther from the origin than this are not part of a map, m."""
_POINT = np.dtype(("<f4", 3))

Tile = tuple[int, int]


class MapTiles:
    """Take clouds one by one and write their map: in each voxel the mean of the points in it.

    Except for rounding, the map depends neither on the order of the tiles nor on the order of the clouds.
    """

    def __init__(self, folder: Path, voxel: float) -> None:
        """Begin an empty map.

        Args:
            folder: folder for the tiles; it is made here, and the caller removes it.
            voxel: edge length, m, 1 mm or more.
        """
        folder.mkdir(parents=True)
        self._folder = folder
        self._voxel = voxel
        self._across = max(1, round(_TILE_M / voxel))
        self._waiting: dict[Tile, list[NDArray[np.float32]]] = defaultdict(list)
        self._waiting_count = 0
        self._tiles: set[Tile] = set()
        self.taken = 0
        """Number of finite points in the clouds so far."""

    def add(self, T_world_imu: NDArray[np.float64], points: NDArray[np.float32]) -> None:
        """Add a cloud.

        Args:
            T_world_imu: (4, 4) pose of the cloud's frame.
            points: (n, 3) m, in the IMU frame; points that are not finite are left out.
        """
        world = points.astype(np.float64) @ T_world_imu[:3, :3].T + T_world_imu[:3, 3]
        world = world[(np.abs(world) < FARTHEST).all(axis=1)]
        if not len(world):
            return
        self.taken += len(world)
        tile = np.floor(world[:, :2] / self._voxel).astype(np.int64) // self._across
        # relative to the tile's corner, where single precision is enough
        world[:, :2] -= tile * (self._across * self._voxel)
        local = world.astype(np.float32)
        order = np.lexsort((tile[:, 1], tile[:, 0]))
        tile, local = tile[order], local[order]
        begins = np.flatnonzero(np.any(np.diff(tile, axis=0, prepend=tile[:1] - 1) != 0, axis=1))
        for begin, part in zip(begins, np.split(local, begins[1:]), strict=True):
            self._waiting[int(tile[begin, 0]), int(tile[begin, 1])].append(part)
        self._waiting_count += len(local)
        if self._waiting_count >= _KEPT:
            self._put_aside()

    def write(self, path: Path) -> int:
        """Write the map, as PCD or PLY by the file's ending, and return its number of points."""
        self._put_aside()
        tiles = sorted(self._tiles)
        counts = [self._thin(tile) for tile in tiles]
        write_cloud(path, self._thinned(tiles), sum(counts))
        return sum(counts)

    def _put_aside(self) -> None:
        for tile, parts in self._waiting.items():
            with self._path(tile).open("ab") as file:
                file.write(np.concatenate(parts).tobytes())
        self._tiles |= self._waiting.keys()
        self._waiting.clear()
        self._waiting_count = 0

    def _thin(self, tile: Tile) -> int:
        """Replace a tile's points by one world point per voxel; return their number."""
        local = np.fromfile(self._path(tile), _POINT).astype(np.float64)
        cell = np.floor(local / self._voxel).astype(np.int64)
        # single precision may round a point into the next tile's first voxel
        cell[:, :2] = np.clip(cell[:, :2], 0, self._across - 1)
        cell[:, 2] -= cell[:, 2].min()
        key = (cell[:, 2] * self._across + cell[:, 1]) * self._across + cell[:, 0]
        _, voxel, count = np.unique(key, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(voxel, axis) for axis in local.T], -1)
        corner = np.array([*tile, 0]) * (self._across * self._voxel)
        world = sums / count[:, None] + corner
        self._path(tile).write_bytes(world.astype(np.float32).tobytes())
        return len(count)

    def _thinned(self, tiles: list[Tile]) -> Iterator[NDArray[np.float32]]:
        for tile in tiles:
            yield np.fromfile(self._path(tile), _POINT)

    def _path(self, tile: Tile) -> Path:
        return self._folder / f"{tile[0]}_{tile[1]}"


SPOOL_SUFFIX = ".spool"
TILES_PREFIX = ".tiles."
"""Begins the name of the hidden folder within a run folder that holds the tiles of a map being written."""
_POINT_BYTES = 3 * np.dtype(np.float32).itemsize


class MapFile(Sink):
    """Appends points new to the map to a spool file, which becomes a PCD at the end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._spool_path = aside_of(path.with_suffix(SPOOL_SUFFIX))
        self._spool = self._spool_path.open("wb")

    def take(self, result: ScanResult) -> None:
        """Append the points that a scan adds to the map."""
        self.append(new_map_points(result))

    def finish(self, run: RunResult) -> None:
        """Write the PCD and hand over its points."""
        run.map_points = self.write()

    def append(self, points: NDArray[np.float32]) -> None:
        """Add (n, 3) points, m, world frame."""
        self._spool.write(np.ascontiguousarray(points, np.float32).tobytes())

    def write(self) -> NDArray[np.float32]:
        """Write the PCD (binary, x y z) and return its (n, 3) points; none can be added afterwards."""
        self._spool.close()
        # an interrupted append may have left a part of a point
        whole = self._spool_path.stat().st_size // _POINT_BYTES
        points = np.fromfile(self._spool_path, np.float32, 3 * whole).reshape(-1, 3)
        write_cloud(self._path, [points], len(points))
        return points

    def close(self) -> None:
        """Remove the spool file in every case."""
        self._spool.close()
        self._spool_path.unlink(missing_ok=True)


def new_map_points(result: ScanResult) -> NDArray[np.float32]:
    """Return the (n, 3) points that a scan adds to the map, m in world."""
    output = result.output
    points = np.asarray(output.points)[np.asarray(output.added)]
    return (points + np.asarray(output.origin)).astype(np.float32)
