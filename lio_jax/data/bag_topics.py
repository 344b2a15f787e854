"""Choose which of a bag's topics is the lidar, the IMU and the GPS."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lio_jax.core.errors import LioJaxError


@dataclass(frozen=True)
class Topic:
    """One topic of a bag with one message type."""

    name: str
    type: str
    count: int
    """Number of messages."""


@dataclass(frozen=True)
class BagContents:
    """What a bag says about itself without any scan being decoded."""

    topics: tuple[Topic, ...]
    lidar: Topic
    """The topic whose clouds are read."""
    imu: Topic | None
    point_fields: tuple[str, ...]
    """Name and type of the fields of a point, as the first cloud has them."""
    size_bytes: int
    """Of all its files."""
    start_ns: int
    """When its first message was received."""
    end_ns: int
    """When its last message was received."""


def bag_topics(connections: Iterable[Any]) -> tuple[Topic, ...]:
    """Sum a bag's connections by topic and type, in order of name."""
    counts: dict[tuple[str, str], int] = {}
    for connection in connections:
        key = (connection.topic, connection.msgtype)
        counts[key] = counts.get(key, 0) + connection.msgcount
    return tuple(Topic(*key, count) for key, count in sorted(counts.items()))


def choose_topic(
    path: Path, topics: tuple[Topic, ...], key: str, wanted: str, types: Mapping[str, str]
) -> tuple[Topic | None, str]:
    """Return the topic to read, and a note where there was a choice.

    Args:
        path: of the bag, for messages.
        topics: all of the bag's.
        key: of the setting that names the topic, such as "lidar_topic".
        wanted: that setting; "" takes the topic with most messages among those of the right type.
        types: message type -> what it is called in a message.

    Raises:
        LioJaxError: ``wanted`` is not in the bag, or is of another type.
    """
    fitting = [topic for topic in topics if topic.type in types]
    if wanted:
        named = [topic for topic in topics if topic.name.strip("/") == wanted.strip("/")]
        if not named:
            raise LioJaxError(
                f"{path}: config.data.{key}={wanted!r} is not in the bag; its topics are {listed(topics)}."
            )
        chosen = next((topic for topic in named if topic.type in types), None)
        if chosen is None:
            expected = " or ".join(dict.fromkeys(types.values()))
            raise LioJaxError(
                f"{path}: config.data.{key}={wanted!r} is {named[0].type}, not {expected}; "
                f"topics of that kind are {listed(fitting) or 'not in the bag'}."
            )
        return chosen, ""
    if not fitting:
        return None, ""
    chosen = max(fitting, key=lambda topic: topic.count)
    others = [topic for topic in fitting if topic is not chosen]
    if not others:
        return chosen, ""
    return chosen, (
        f"topic {chosen.name} was taken ({chosen.count} messages); there is also {listed(others)}: "
        f"choose with --set config.data.{key}={others[0].name}"
    )


def listed(topics: Iterable[Topic]) -> str:
    """Write topics with type and number of messages, separated by commas."""
    return ", ".join(f"{topic.name} ({topic.type}, {topic.count})" for topic in topics)
