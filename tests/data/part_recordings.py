"""A sensor that turns without a pause, and its messages as drivers cut them: parts of a turn or turns."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lio_jax.data.config import DataConfig
from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.sequence import LidarScan
from lio_jax.sim.sequence import SimulatedSequence
from tests.data import bags
from tests.data.bag_recordings import AUTO

RINGS = 16
XYZI = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
LATENCY_NS = 2_000_000
FIFTH_NS = bags.PERIOD_NS // 5


@dataclass(frozen=True)
class Firings:
    """All returns of a recording in the order of firing: columns of 16 beams."""

    since_ns: np.ndarray
    """(n,) ns from the recording's start, int64."""
    points: np.ndarray
    ring: np.ndarray
    intensity: np.ndarray

    def seen(self, kept: np.ndarray, begin_ns: int = 0) -> bags.Sweep:
        """Return some of them, timed in s from ``begin_ns``."""
        time = (self.since_ns[kept] - begin_ns) * 1e-9
        return bags.Sweep(self.points[kept], time, self.ring[kept], self.intensity[kept])


def firings(
    turns: float = 12.0,
    columns: int = 360,
    period_ns: int = bags.PERIOD_NS,
    start_deg: float = 0.0,
    clockwise: bool = True,
) -> Firings:
    """Return the returns of a turning sensor in an oval room.

    Args:
        turns: number of turns.
        columns: firings in a turn.
        period_ns: duration of a turn, ns.
        start_deg: azimuth atan2(y, x) of the first firing, deg.
        clockwise: direction seen from above.
    """
    column = np.arange(round(turns * columns)).repeat(RINGS)
    ring = np.tile(np.arange(RINGS), round(turns * columns))
    turned = 2 * np.pi * column / columns * (-1 if clockwise else 1)
    azimuth = np.radians(start_deg) + turned
    elevation = np.radians(-15.0 + 2.0 * ring)
    radius = 10.0 + 4.0 * np.cos(azimuth) ** 2 + 0.1 * ring
    directions = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    points = (radius * np.stack(directions)).T.astype(np.float32)
    return Firings(column * period_ns // columns, points, ring, (column % 200).astype(np.float32))


def parts(
    all_of_them: Firings, length_ns: int, kept: np.ndarray | None = None
) -> list[tuple[int, np.ndarray]]:
    """Cut firings into messages of one length; return the begin of each (ns) and its firings."""
    place = all_of_them.since_ns // length_ns
    cut = []
    for number in range(int(place.max()) + 1):
        inside = place == number
        cut.append((number * length_ns, np.flatnonzero(inside if kept is None else inside & kept)))
    return cut


Driver = Callable[[Firings, int, int, np.ndarray, bool], bags.Message]
"""Makes a message of its begin and end (ns from the recording's start) and its firings; ROS 2 or 1."""


def velodyne(seen: Firings, begin_ns: int, end_ns: int, kept: np.ndarray, ros2: bool) -> bags.Message:
    """velodyne_pointcloud with timestamp_first_packet: float32 seconds from the header stamp."""
    cloud = seen.seen(kept, begin_ns)
    return _message(bags.fill(bags.VELODYNE, cloud, cloud.time), begin_ns, end_ns, ros2)


def velodyne_at_end(seen: Firings, begin_ns: int, end_ns: int, kept: np.ndarray, ros2: bool) -> bags.Message:
    """velodyne_pointcloud as it is by default: the stamp is that of the last packet, times are negative."""
    cloud = seen.seen(kept, end_ns)
    return _message(bags.fill(bags.VELODYNE, cloud, cloud.time), end_ns, end_ns, ros2)


def hesai(seen: Firings, begin_ns: int, end_ns: int, kept: np.ndarray, ros2: bool) -> bags.Message:
    """HesaiLidar_ROS: float64 seconds since 1970."""
    cloud = seen.seen(kept)
    times = (bags.START_NS + seen.since_ns[kept]) * 1e-9
    return _message(bags.fill(bags.HESAI, cloud, times), begin_ns, end_ns, ros2)


def ouster(seen: Firings, begin_ns: int, end_ns: int, kept: np.ndarray, ros2: bool) -> bags.Message:
    """The layout of ouster_ros: uint32 nanoseconds from the header stamp."""
    cloud = seen.seen(kept)
    return _message(bags.fill(bags.OUSTER, cloud, seen.since_ns[kept] - begin_ns), begin_ns, end_ns, ros2)


def bare(seen: Firings, begin_ns: int, end_ns: int, kept: np.ndarray, ros2: bool) -> bags.Message:
    """The bags of Cartographer's backpack: a PointCloud2 for each UDP packet, without times and rings."""
    return _message(bags.fill(XYZI, seen.seen(kept)), begin_ns, end_ns, ros2)


def recorded(
    seen: Firings, cut: Iterable[tuple[int, np.ndarray]], length_ns: int, driver: Driver, ros2: bool = True
) -> list[bags.Message]:
    """Return the messages of a driver, one for each piece that was cut."""
    return [driver(seen, begin, begin + length_ns, kept, ros2) for begin, kept in cut]


def _message(cloud: np.ndarray, stamp_ns: int, end_ns: int, ros2: bool) -> bags.Message:
    stamp = bags.START_NS + stamp_ns
    return "/points", bags.START_NS + end_ns + LATENCY_NS, bags.cloud_message(stamp, cloud, ros2)


def scans_of(seen: Firings, cut: Iterable[tuple[int, np.ndarray]], length_ns: int) -> list[LidarScan]:
    """Return pieces as a program has them that pushes what its driver calls a scan."""
    pushed = []
    for begin, kept in cut:
        part = seen.seen(kept, begin)
        pushed.append(
            LidarScan(
                bags.START_NS + begin,
                part.points,
                part.time.astype(np.float32),
                part.ring.astype(np.int32),
                part.intensity,
                length_ns * 1e-9,
            )
        )
    return pushed


def simulated(sensor: str, number: float, jitter: float = 0.0) -> list[bags.Message]:
    """Return 0.8 s of a simulated sensor in a room, in the layout of a Velodyne, in so many messages a turn.

    Args:
        sensor: name of the sensor.
        number: messages in 0.1 s.
        jitter: standard deviation of the stamps' errors as a share of a message.
    """
    scans = list(SimulatedSequence("room", sensor, duration_s=0.8, seed=2).scans())
    since = [s.stamp_ns - scans[0].stamp_ns + np.round(s.time.astype(np.float64) * 1e9) for s in scans]
    since_ns = np.concatenate(since).astype(np.int64)
    order = np.argsort(since_ns, kind="stable")
    fields = ("points", "ring", "intensity")
    seen = Firings(since_ns[order], *(np.concatenate([getattr(s, f) for s in scans])[order] for f in fields))
    length = round(bags.PERIOD_NS / number)
    errors = np.random.default_rng(0).normal(0.0, jitter * length, 4000).round().astype(int)
    return [
        velodyne(seen, max(0, begin + int(error)), begin + length, kept, True)
        for (begin, kept), error in zip(parts(seen, length), errors, strict=False)
    ]


def opened(path: Path, messages: Sequence[bags.Message], config: DataConfig = AUTO) -> RosbagSequence:
    return RosbagSequence(bags.write_bag(path, messages), config)


def joined_note(sequence: RosbagSequence) -> str:
    (note,) = [note for note in sequence.info.notes if "joined" in note]
    return note


def is_joined(sequence: RosbagSequence) -> bool:
    return any("joined" in note for note in sequence.info.notes)
