"""Read ROS 1 and ROS 2 bags as a Sequence: clouds are streamed, IMU and GPS samples are read in one pass."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lio_jax.core.errors import LioJaxError
from lio_jax.data import pointcloud2
from lio_jax.data.bag_extrinsic import bag_extrinsic
from lio_jax.data.bag_files import (
    BagContents,
    Topic,
    bag_paths,
    bag_topics,
    open_bag,
    read_header,
    until_damage,
)
from lio_jax.data.clock_difference import clock_difference
from lio_jax.data.cloud_fields import RawCloud
from lio_jax.data.config import DataConfig
from lio_jax.data.imu_checks import accel_scale
from lio_jax.data.joined_messages import Joining, Part, grouped, order_of
from lio_jax.data.navigation_messages import GpsCollector, ImuCollector
from lio_jax.data.part_recognition import recognise_messages
from lio_jax.data.pointcloud2 import decode_cloud
from lio_jax.data.scan_reading import ScanReading
from lio_jax.data.sequence import (
    GpsData,
    ImuData,
    LidarScan,
    Reader,
    SequenceBase,
    SequenceInfo,
    WarningLog,
    entries,
    scans_from,
)
from lio_jax.data.time_order import Stamped, in_time_order
from lio_jax.data.topics import topics_to_read

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader


class RosbagSequence(SequenceBase):
    """A bag, or a folder of the split bags of one recording.

    Each pass over the data opens the bag again, so one thread may decode scans while another asks for
    inertial samples. Notes about IMU and GPS join :attr:`info` once these have been read.
    """

    def __init__(self, path: Path, config: DataConfig) -> None:
        """Choose topics, and settle from the first clouds how they are read.

        Raises:
            LioJaxError: no bag, a damaged bag, no point clouds, or a topic or field that is not in the bag.
        """
        super().__init__()
        self._path, self._config = path, config
        self._paths = bag_paths(path)
        self._samples: tuple[ImuData | None, GpsData | None] | None = None
        self._received: tuple[int | None, int | None] = (None, None)
        self._whole = self
        self._sweeps: list[int] | None = None
        with open_bag(self._paths) as reader:
            topics = bag_topics(reader.connections)
            self._lidar, self._imu_topic, self._gps_topic, chosen = topics_to_read(path, topics, config)
            self._reading, self._joining = self._recognised(reader)
            self._T_imu_lidar, tied = bag_extrinsic(
                reader, topics, self._imu_topic, self._lidar, self._damaged_topic
            )
        pieces = [f"{len(self._paths)} files read as one recording"] if len(self._paths) > 1 else []
        self._notes = [*pieces, *chosen, *([tied] if tied else []), *self._reading.notes]

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        return SequenceInfo(
            name=self._path.name if self._path.is_dir() else self._path.stem,
            format="rosbag",
            path=str(self._path),
            scan_count=self._lidar.count if self._joining is None else len(self._whole._first_messages()),
            T_imu_lidar=self._T_imu_lidar,
            notes=tuple(self._notes),
        )

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans ``start`` to ``start + count`` by their place in the bag; an empty scan has n = 0.

        If the bag turns out to be damaged, the iteration ends with a warning. A message that cannot be
        decoded, a duplicate, a step back in time and a wrong stamp are left out with a warning.
        """
        if self._joining is not None:
            yield from self._joined(self._joining, start, count)
            return
        yield from in_time_order(self._decoded(start, count), self._log.add)

    def _decoded(self, start: int, count: int | None) -> Iterator[Stamped[LidarScan]]:
        stop = scans_from(start, count).stop
        with open_bag(self._paths) as reader:
            for number, cloud in self._clouds(reader, start, stop, self._log.add):
                name = f"{self._path.name}: scan {number}"
                scan = self._reading.scan(cloud, name, self._log.add)
                yield Stamped(scan.stamp_ns, name, scan)

    def _joined(self, joining: Joining, start: int, count: int | None) -> Iterator[LidarScan]:
        firsts = self._first_messages() if start else [0]
        if start >= len(firsts):
            return
        with open_bag(self._paths) as reader:
            for number, parts in enumerate(self._parts(reader, joining, firsts[start], self._log.add), start):
                if count is not None and number >= start + count:
                    return
                whole = joining.whole([part.cloud for part in parts])
                yield self._reading.scan(whole, f"{self._path.name}: scan {number}", self._log.add)

    def _first_messages(self) -> list[int]:
        """Return the number of the first message of each scan: a pass over all messages, once."""
        if self._sweeps is None:
            assert self._joining is not None
            with open_bag(self._paths) as reader:
                sweeps = self._parts(reader, self._joining, 0, lambda sentence: None)
                self._sweeps = [parts[0].number for parts in sweeps]
        return self._sweeps

    def _parts(
        self, reader: "AnyReader", joining: Joining, first: int, warn: Callable[[str], None]
    ) -> Iterator[list[Part]]:
        """Yield the messages of each sweep, from the given message on."""

        def stamped() -> Iterator[Stamped[Part]]:
            for number, cloud in self._clouds(reader, first, None, warn):
                start_ns = joining.start_ns(cloud)
                yield Stamped(start_ns, f"{self._path.name}: message {number}", Part(number, start_ns, cloud))

        return grouped(in_time_order(stamped(), warn), order_of(joining), first == 0)

    def _clouds(
        self, reader: "AnyReader", start: int, stop: int | None, warn: Callable[[str], None]
    ) -> Iterator[tuple[int, RawCloud]]:
        """Yield the clouds of messages ``start`` to ``stop`` with their numbers, damaged ones left out."""
        for number, raw in self._lidar_messages(reader, warn):
            if stop is not None and number >= stop:
                return
            if number < start:
                continue
            try:
                yield number, decode_cloud(reader, self._lidar, raw, self._config.time_field, self._where)
            except ValueError as error:
                name = f"{self._path.name}: {self._unit} {number}"
                warn(f"{name} cannot be read and was skipped: {error}.")

    def within(self, start_ns: int, end_ns: int) -> "RosbagSequence":
        """Return the part whose messages were received from ``start_ns`` up to ``end_ns``.

        The part is found by the bag's index, without reading the messages before it. Its scans count from 0;
        ``info.scan_count`` is still that of the whole bag.
        """
        part = copy(self)
        part._received, part._samples, part._log = (start_ns, end_ns), None, WarningLog()
        part._sweeps = None
        part._notes = list(self._notes)
        return part

    def contents(self) -> BagContents:
        """Return what the bag's index and its first cloud state."""
        fields: tuple[str, ...] = ()
        with open_bag(self._paths) as reader:
            for _, raw in self._lidar_messages(reader, self._log.add):
                if self._lidar.type in pointcloud2.LIVOX_TYPES:
                    fields = pointcloud2.custom_msg_field_names()
                else:
                    # a damaged message is reported where it is decoded
                    with suppress(Exception):
                        fields = pointcloud2.field_names(reader.deserialize(raw, self._lidar.type))
                break
            return BagContents(
                topics=bag_topics(reader.connections),
                lidar=self._lidar,
                imu=self._imu_topic,
                point_fields=fields,
                size_bytes=sum(_size(path) for path in self._paths),
                start_ns=reader.start_time,
                end_ns=reader.end_time,
            )

    def header_stamps(self) -> Iterator[int]:
        """Yield the header stamp in ns of every cloud without decoding any."""
        with open_bag(self._paths) as reader:
            for _, raw in self._lidar_messages(reader, self._log.add):
                yield read_header(raw, reader.is2).stamp_ns

    def imu(self) -> ImuData | None:
        """Return all inertial samples, or None where there are none."""
        return self._read_samples()[0]

    def gps(self) -> GpsData | None:
        """Return all GPS fixes, or None where there are none."""
        return self._read_samples()[1]

    @property
    def _unit(self) -> str:
        """Return what a message is called in warnings."""
        return "scan" if self._joining is None else "message"

    def _damaged_topic(self, topic: str, reason: str) -> None:
        self._log.add(f"{self._path}: {topic} is damaged ({reason}).")

    @property
    def _where(self) -> str:
        return f"{self._path}: topic {self._lidar.name}"

    def _recognised(self, reader: "AnyReader") -> tuple[ScanReading, Joining | None]:
        """Settle from the topic's first clouds with points how its clouds are read and joined."""
        undecoded: list[str] = []
        damage: list[str] = []

        def decoded() -> Iterator[tuple[RawCloud, int]]:
            messages = until_damage(self._messages(reader, self._lidar), damage.append)
            for _, received_ns, raw in messages:
                try:
                    cloud = decode_cloud(reader, self._lidar, raw, self._config.time_field, self._where)
                except ValueError as error:
                    undecoded.append(str(error))
                    continue
                yield cloud, received_ns

        found = recognise_messages(decoded(), self._config, self._where)
        if found is None:
            reason = "".join(f" ({cause})" for cause in [*damage, *undecoded][-1:])
            raise LioJaxError(
                f"{self._where}: no point cloud can be read{reason}; the recording is empty or damaged there."
            )
        return found

    def _lidar_messages(
        self, reader: "AnyReader", warn: Callable[[str], None]
    ) -> Iterator[tuple[int, bytes]]:
        last = -1

        def broken(reason: str) -> None:
            warn(
                f"{self._path}: the bag is damaged after {self._unit} {last} of {self._lidar.count} "
                f"({reason}): reading ended there."
            )

        for number, (_, _, raw) in enumerate(until_damage(self._messages(reader, self._lidar), broken)):
            last = number
            yield number, raw

    def _read_samples(self) -> tuple[ImuData | None, GpsData | None]:
        if self._samples is None:
            topics = [topic for topic in (self._imu_topic, self._gps_topic) if topic is not None]
            self._samples = self._gather(topics) if topics else (None, None)
        return self._samples

    def _gather(self, topics: list[Topic]) -> tuple[ImuData | None, GpsData | None]:
        def broken(reason: str) -> None:
            self._log.add(f"{self._path}: the bag is damaged ({reason}): IMU and GPS samples end there.")

        with open_bag(self._paths) as reader:
            imu, gps = ImuCollector(reader.is2), GpsCollector()
            take: dict[str, Callable[[bytes], None]] = {}
            if self._imu_topic is not None:
                take[self._imu_topic.name] = imu.add
            if self._gps_topic is not None:
                gps_type = self._gps_topic.type
                take[self._gps_topic.name] = lambda raw: gps.add(reader.deserialize(raw, gps_type))
            unreadable = dict.fromkeys(take, 0)
            for connection, _, raw in until_damage(self._messages(reader, *topics), broken):
                # a damaged record may belong to a topic that was not asked for
                if connection.topic not in take:
                    continue
                try:
                    take[connection.topic](raw)
                # The generated decoders raise exceptions of many kinds on damaged bytes.
                except Exception:
                    unreadable[connection.topic] += 1
        for name, number in unreadable.items():
            if number:
                self._log.add(f"{self._path}: {number} messages of {name} cannot be read and were skipped.")
        return self._finished_imu(imu), self._finished_gps(gps)

    def _finished_imu(self, collector: ImuCollector) -> ImuData | None:
        imu, repairs = collector.imu()
        for repair in repairs:
            self._log.add(f"{self._path}: {repair}")
        if imu is None:
            return None
        scale, note = accel_scale(imu.accel, self._config)
        if note:
            self._notes.append(f"imu: {note}")
        shift_ns = self._clock_difference() if self._config.align_clocks else 0
        return ImuData(imu.stamp_ns + shift_ns, imu.gyro, imu.accel * scale, imu.orientation)

    def _clock_difference(self) -> int:
        """Return by how much the lidar's clock is ahead of the IMU's, ns, and note it."""
        with open_bag(self._paths) as reader:

            def scan_end_ns(raw: bytes) -> int:
                cloud = decode_cloud(reader, self._lidar, raw, self._config.time_field, self._where)
                return self._reading.scan(cloud, "", lambda sentence: None).end_ns

            topics = [topic for topic in (self._lidar, self._imu_topic) if topic is not None]
            messages = until_damage(self._messages(reader, *topics), lambda reason: None)
            difference = clock_difference(
                ((connection.topic == self._lidar.name, raw) for connection, _, raw in messages),
                scan_end_ns,
                lambda raw: read_header(raw, reader.is2).stamp_ns,
            )
        if difference:
            self._notes.append(
                f"imu: {difference * 1e-9:+.3f} s were added to its stamps, to align the clocks"
            )
        return difference

    def _finished_gps(self, collector: GpsCollector) -> GpsData | None:
        gps, notes = collector.gps()
        self._notes.extend(notes)
        return gps

    def _messages(self, reader: "AnyReader", *topics: Topic) -> Iterator[tuple[Any, int, bytes]]:
        wanted = {(topic.name, topic.type) for topic in topics}
        connections = [c for c in reader.connections if (c.topic, c.msgtype) in wanted]
        start, stop = self._received
        return reader.messages(connections, start=start, stop=stop)


def _size(path: Path) -> int:
    files = [path] if path.is_file() else path.iterdir()
    return sum(file.stat().st_size for file in files if file.is_file())


BAG_SUFFIXES = (".bag", ".db3", ".mcap")
"""Endings of files that are read as bags."""


def _is_bag(path: Path) -> bool:
    if path.is_file():
        is_bag = path.suffix in BAG_SUFFIXES or path.name == "metadata.yaml"
        return is_bag or path.name.endswith(".bag.active")
    if (path / "metadata.yaml").is_file():
        return True
    return any(entry.suffix in BAG_SUFFIXES for entry in entries(path))


READER = Reader(
    "rosbag",
    "a ROS 2 bag folder (metadata.yaml) or a bag file (.bag, .db3, .mcap)",
    _is_bag,
    RosbagSequence,
    reads=frozenset(
        [
            "lidar_topic",
            "imu_topic",
            "gps_topic",
            "time_field",
            "time_unit",
            "time_reference",
            "stamp_at",
            "accel_unit",
            "compensated",
            "messages_per_scan",
            "beams",
            "align_clocks",
            "scan_period",
        ]
    ),
    has_parts=False,
)
