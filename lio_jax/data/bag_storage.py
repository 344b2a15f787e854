"""Make ROS bags: a ROS 1 file, a ROS 2 folder, or the single sqlite3 or mcap file of one."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lio_jax.core.errors import UsageError
from lio_jax.data import static_transforms
from lio_jax.data.ros_messages import Message
from lio_jax.data.whole_output import written_whole

if TYPE_CHECKING:
    from rosbags.interfaces import Qos

BagFormat = Literal["ros1", "ros2-sqlite3", "ros2-mcap"]

FORMAT_OF_ENDING: dict[str, BagFormat] = {".bag": "ros1", ".db3": "ros2-sqlite3", ".mcap": "ros2-mcap"}
"""What the ending of a bag's name tells."""

_ENDINGS: dict[str, tuple[str, ...]] = {
    "ros1": (".bag",),
    "ros2-sqlite3": (".db3", ""),
    "ros2-mcap": (".mcap", ""),
}
"""Of a path that each format may be written to; "" stands for a folder."""

_RECORDING = "recording"
"""Of the storage file in a ROS 2 bag: always the same, so that the bytes do not depend on where they lie."""

_ROS2_VERSION: Literal[8] = 8
"""Newest metadata that ROS 2 Humble as well as its successors can read."""


def check_ending(path: Path, bag_format: BagFormat) -> None:
    """Refuse a path by whose ending a reader would expect another format.

    Raises:
        UsageError: the ending belongs to another format, or ROS 1 is asked for without ".bag".
    """
    endings = _ENDINGS[bag_format]
    known = {ending for of_format in _ENDINGS.values() for ending in of_format if ending}
    ending = path.suffix if path.suffix in known else ""
    if ending not in endings:
        wanted = " or ".join(ending or "a folder without an ending" for ending in endings)
        raise UsageError(f"{path}: a {bag_format} recording is {wanted}; choose another path or format.")
    if bag_format == "ros2-sqlite3" and set(str(path.resolve())) & set("?#%"):
        raise UsageError(f"{path}: sqlite3 cannot write to a path with '?', '#' or '%'; choose another.")


@contextmanager
def new_bag(
    path: Path, bag_format: BagFormat, typestore: Any, overwrite: bool
) -> Iterator[Callable[[Message], None]]:
    """Yield the function that stores a message; the bag appears whole when the block ends well.

    Args:
        path: file, or folder for a ROS 2 bag with its metadata.yaml.
        bag_format: container.
        typestore: rosbags definitions of the messages.
        overwrite: replace a bag that is there.

    Raises:
        UsageError: ``path`` is taken or does not fit the format.
        LioJaxError: the disk takes no more.
    """
    check_ending(path, bag_format)
    is_file = bool(path.suffix) and path.suffix in _ENDINGS[bag_format]
    with written_whole(path, overwrite, "" if is_file else "metadata.yaml") as made:
        if bag_format == "ros1":
            with _ros1_writer(made, typestore) as store:
                yield store
            return
        folder = made.parent / _RECORDING
        with _ros2_writer(folder, bag_format, typestore) as store:
            yield store
        # the file describes itself; without the folder's metadata.yaml it can be played as well
        os.replace(folder / f"{_RECORDING}{path.suffix}" if is_file else folder, made)


@contextmanager
def _ros1_writer(path: Path, typestore: Any) -> Iterator[Callable[[Message], None]]:
    from rosbags.rosbag1 import Writer

    with Writer(path) as writer:

        def connect(topic: str, kind: str) -> Any:
            latching = 1 if kind == static_transforms.TYPE else None
            return writer.add_connection(topic, kind, typestore=typestore, latching=latching)

        yield _storing(writer, connect)


@contextmanager
def _ros2_writer(folder: Path, bag_format: BagFormat, typestore: Any) -> Iterator[Callable[[Message], None]]:
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = StoragePlugin.MCAP if bag_format == "ros2-mcap" else StoragePlugin.SQLITE3
    with Writer(folder, version=_ROS2_VERSION, storage_plugin=plugin) as writer:

        def connect(topic: str, kind: str) -> Any:
            offered = [_latched()] if kind == static_transforms.TYPE else []
            return writer.add_connection(topic, kind, typestore=typestore, offered_qos_profiles=offered)

        yield _storing(writer, connect)


def _storing(writer: Any, connect: Callable[[str, str], Any]) -> Callable[[Message], None]:
    connections: dict[tuple[str, str], Any] = {}

    def store(message: Message) -> None:
        key = (message.topic, message.type)
        if key not in connections:
            connections[key] = connect(*key)
        writer.write(connections[key], message.received_ns, message.raw)

    return store


def _latched() -> "Qos":
    """Return the quality of service of /tf_static: whoever subscribes later still gets it."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    unlimited = QosTime(0, 0)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        unlimited,
        unlimited,
        QosLiveliness.AUTOMATIC,
        unlimited,
        False,
    )
