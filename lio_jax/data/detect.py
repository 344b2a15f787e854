"""Choose the reader of a recording by the layout of its path."""

from collections.abc import Callable
from pathlib import Path

from lio_jax.core.errors import LioJaxError
from lio_jax.data.config import DataConfig
from lio_jax.data.sequence import Sequence

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
"""Endings of files that are read as bags."""

_LOOKED_FOR = (
    "a KITTI odometry sequence (velodyne/*.bin), a KITTI raw drive (velodyne_points/data), "
    "a native folder (meta.yaml and scans/), a ROS 2 bag folder (metadata.yaml) "
    "or a bag file (.bag, .db3, .mcap)"
)
_SEARCH_DEPTH = 3
_NAMED_AT_MOST = 12


def open_sequence(path: Path | str, config: DataConfig | None = None) -> Sequence:
    """Open the recording at ``path`` with the reader that fits its layout.

    Args:
        path: a KITTI odometry sequence folder, a KITTI raw drive folder, a ROS 1 or ROS 2 bag, or a native
            folder.
        config: how the recording is read; None: the defaults, which recognise everything from the data.

    Raises:
        LioJaxError: nothing is there, the layout is not known, or the reader finds it broken.
    """
    path = Path(path)
    config = DataConfig() if config is None else config
    if not path.exists():
        raise LioJaxError(f"{path}: no such file or folder; check the path.")
    kind = _kind(path)
    if kind is None:
        raise LioJaxError(_unknown(path))
    return _READERS[kind](path, config)


def _kind(path: Path) -> str | None:
    """Return which reader takes ``path``, or None."""
    if path.is_file():
        is_bag = path.suffix in BAG_SUFFIXES or path.name == "metadata.yaml"
        return "rosbag" if is_bag or path.name.endswith(".bag.active") else None
    if (path / "meta.yaml").is_file():
        return "native"
    if (path / "metadata.yaml").is_file():
        return "rosbag"
    if (path / "velodyne_points").is_dir():
        return "kitti_raw"
    if (path / "velodyne").is_dir():
        return "kitti_odometry"
    return "rosbag" if any(entry.suffix in BAG_SUFFIXES for entry in _entries(path)) else None


def _unknown(path: Path) -> str:
    for parent in path.resolve().parents[:2]:
        if _kind(parent) in ("kitti_raw", "kitti_odometry", "native"):
            return f"{path}: is a part of a recording; give the recording's folder, {parent}."
    if path.is_file():
        return f"{path}: not a recording that can be read; looked for {_LOOKED_FOR}."
    if not _entries(path):
        return f"{path}: the folder is empty; give {_LOOKED_FOR}."
    if inside := _recordings_inside(path, _SEARCH_DEPTH):
        names = ", ".join(str(found.relative_to(path)) for found in inside[:_NAMED_AT_MOST])
        more = f" and {len(inside) - _NAMED_AT_MOST} more" if len(inside) > _NAMED_AT_MOST else ""
        return f"{path}: is not a recording itself; give one of those inside it: {names}{more}."
    return f"{path}: the layout is not known; looked for {_LOOKED_FOR}."


def _recordings_inside(folder: Path, depth: int) -> list[Path]:
    found: list[Path] = []
    for entry in _entries(folder):
        if _kind(entry) is not None:
            found.append(entry)
        elif depth > 1 and entry.is_dir():
            found.extend(_recordings_inside(entry, depth - 1))
    return found


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise LioJaxError(f"{folder}: cannot be listed ({error.strerror}); check its permissions.") from None


def _open_kitti(path: Path, config: DataConfig) -> Sequence:
    from lio_jax.data.kitti import KittiSequence

    return KittiSequence(path, config)


def _open_kitti_raw(path: Path, config: DataConfig) -> Sequence:
    from lio_jax.data.kitti_raw import KittiRawSequence

    return KittiRawSequence(path, config)


def _open_native(path: Path, config: DataConfig) -> Sequence:
    from lio_jax.data.native import NativeSequence

    return NativeSequence(path, config)


def _open_rosbag(path: Path, config: DataConfig) -> Sequence:
    from lio_jax.data.rosbag import RosbagSequence

    return RosbagSequence(path, config)


_READERS: dict[str, Callable[[Path, DataConfig], Sequence]] = {
    "kitti_odometry": _open_kitti,
    "kitti_raw": _open_kitti_raw,
    "native": _open_native,
    "rosbag": _open_rosbag,
}
