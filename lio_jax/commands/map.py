"""``lio-jax map``: write the map of a run at a chosen resolution."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from lio_jax.commands.runtime import say
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.whole_output import written_whole
from lio_jax.run.keyframes import FOLDER, Part, read_keyframes
from lio_jax.run.map_file import MapTiles, check_ending, read_cloud

_FINEST = 1e-3
_AT_ONCE = 1_000_000

Clouds = Iterator[tuple[NDArray[np.float64], NDArray[np.float32]]]


def make_map(folder: Path, out: Path, voxel: float, part: Part, overwrite: bool) -> None:
    """Write a run's map with one point per voxel, from its keyframes, or from its map.pcd if it kept none.

    Raises:
        UsageError: an impossible size or ending, or the file exists.
        LioJaxError: the folder is not a run's, lacks the requested part, or is damaged.
    """
    check_ending(out)
    if not (math.isfinite(voxel) and voxel >= _FINEST):
        raise UsageError(f"--voxel must be {_FINEST} m or more, not {voxel:g}.")
    clouds, count, unit = _clouds(folder, part)
    with written_whole(out, overwrite) as made:
        tiles = MapTiles(made.parent / "tiles", voxel)
        for T_world_imu, points in tqdm(clouds, total=count, unit=unit, disable=None, leave=False):
            tiles.add(T_world_imu, points)
        if not tiles.taken:
            raise LioJaxError(f"{folder}: the run kept no points{_of(part)}; there is no map to write.")
        written = tiles.write(made)
    print(f"map     {out}\npoints  {written} of {tiles.taken}{_of(part)}, one per {voxel:g} m")


def _clouds(folder: Path, part: Part) -> tuple[Clouds, int, str]:
    """Return poses and points of the run's clouds, the number of clouds, and their name for messages."""
    if (folder / FOLDER).is_dir():
        kept = read_keyframes(folder)
        lost = np.sum(~np.isfinite(kept.T_world_imu).all(axis=(1, 2)))
        if lost:
            say(f"warning: {folder}: {lost} keyframe(s) without a finite pose were left out.")
        return kept.clouds(part), len(kept.stamps_ns) - int(lost), "keyframe"
    path = folder / "map.pcd"
    if not path.is_file():
        raise LioJaxError(
            f"{folder}: holds neither {FOLDER}/ nor map.pcd; give a folder that lio-jax run wrote."
        )
    if part != "whole":
        raise LioJaxError(
            f"{folder}: map.pcd does not separate corners from surfaces, and the run kept no keyframes; take "
            "--part whole."
        )
    say(f"note: {folder}: the run kept no keyframes; its map.pcd is taken, no finer than it was saved.")
    points = read_cloud(path)
    parts = np.array_split(points, len(points) // _AT_ONCE + 1)
    return ((np.eye(4), part) for part in parts), len(parts), "part"


def _of(part: Part) -> str:
    return "" if part == "whole" else f" of {part}s"
