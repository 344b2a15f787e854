"""What a recording is, one protocol for all formats; what a reader is; and scans decoded ahead on a
thread."""

import os
import queue
import threading
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, one_line
from lio_jax.data.config import DataConfig
from lio_jax.data.trajectory import Trajectory


class WarningLog:
    """Collect sentences, each once, in the order in which they first occurred."""

    def __init__(self) -> None:
        self._sentences: dict[str, None] = {}

    def add(self, sentence: str) -> None:
        """Remember ``sentence`` unless it is known already."""
        self._sentences[one_line(sentence)] = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """All sentences so far; it may be read while another thread decodes."""
        return tuple(self._sentences.copy())


@dataclass(frozen=True)
class LidarScan:
    """One sweep as it was recorded, without NaN, infinite and zero returns."""

    stamp_ns: int
    """Absolute time of the scan's start, ns."""
    points: NDArray[np.float32]
    """Points in the lidar frame at each point's own firing time, (n, 3) m."""
    time: NDArray[np.float32]
    """Time of each point from the scan's start, (n,) s, within [0, duration]."""
    ring: NDArray[np.int32]
    """Beam index of each point, (n,)."""
    intensity: NDArray[np.float32]
    """Intensity in the sensor's scale, (n,)."""
    duration: float
    """Time from scan start to scan end, s; 0 for a sweep that is already motion compensated."""
    dropped: int = 0
    """Number of recorded firings without a return: NaN, infinite or zero."""

    @property
    def end_ns(self) -> int:
        """Absolute time of the scan's end, ns: the instant to which the scan's pose refers."""
        return self.stamp_ns + round(self.duration * 1e9)


@dataclass(frozen=True)
class ImuData:
    """All inertial samples of a recording, in time order."""

    stamp_ns: NDArray[np.int64]
    """Absolute time of each sample, (m,) ns, ascending."""
    gyro: NDArray[np.float64]
    """Angular rate, (m, 3) rad/s, IMU frame."""
    accel: NDArray[np.float64]
    """Specific force, (m, 3) m/s^2, IMU frame; +g upwards at rest."""
    orientation: NDArray[np.float64] | None = None
    """Quaternion xyzw of T_world_imu from a 9-axis unit, (m, 4); None where the unit has none."""


@dataclass(frozen=True)
class GpsData:
    """All GPS fixes of a recording in a local east-north-up frame around ``origin``."""

    stamp_ns: NDArray[np.int64]
    """Absolute time of each fix, (m,) ns, ascending."""
    position: NDArray[np.float64]
    """Position, (m, 3) m, ENU."""
    covariance: NDArray[np.float64]
    """Covariance of the position, (m, 3, 3) m^2, ENU."""
    origin: tuple[float, float, float]
    """Latitude (deg), longitude (deg), altitude (m) of the frame's origin; NaN where positions are local."""


@dataclass(frozen=True)
class SequenceInfo:
    """What is known about a recording before its first scan is decoded."""

    name: str
    """Short name of the recording for titles and file names."""
    format: str
    """Reader that opened it: kitti_odometry, kitti_raw, rosbag, native, velodyne_pcap, ouster_pcap, clouds or
    evalio; or "simulated", or
    "pushed" for data that arrive in turn."""
    path: str
    scan_count: int
    T_imu_lidar: NDArray[np.float64] | None = None
    """Pose of the lidar in the IMU frame, (4, 4), from the recording's calibration; None where unknown."""
    sensor: str = ""
    """Sensor model where it is known."""
    notes: tuple[str, ...] = field(default_factory=tuple)
    """One sentence for each thing that was recognised, assumed or repaired on opening."""


class Sequence(Protocol):
    """A recording that can be replayed any number of times."""

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        ...

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans ``start`` to ``start + count`` in recorded order; a scan may be empty.

        A scan that cannot be decoded is skipped and reported through ``warnings_so_far``.
        """
        ...

    def imu(self) -> ImuData | None:
        """Return all inertial samples, or None where there are none."""
        ...

    def gps(self) -> GpsData | None:
        """Return all GPS fixes, or None where there are none."""
        ...

    def truth(self) -> Trajectory | None:
        """Return the ground-truth T_world_imu, or None where there is none."""
        ...

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        """Return one sentence for each problem met so far (missing, empty, unreadable scan)."""
        ...


class SequenceBase:
    """Reader of a recording with scans only: a format that holds more defines ``imu``, ``gps`` or ``truth``.

    A reader adds its warnings to ``self._log``.
    """

    def __init__(self) -> None:
        self._log = WarningLog()

    def imu(self) -> ImuData | None:
        """Return None: there are no inertial samples."""
        return None

    def gps(self) -> GpsData | None:
        """Return None: there are no GPS fixes."""
        return None

    def truth(self) -> Trajectory | None:
        """Return None: there is no ground truth."""
        return None

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        """Return one sentence for each problem met so far."""
        return self._log.sentences


def scans_from(start: int, count: int | None) -> slice:
    """Return where the scans ``start`` to ``start + count`` stand in a list; a count of None: to the end."""
    return slice(start, None if count is None else start + count)


T = TypeVar("T")


@dataclass(frozen=True)
class _End:
    error: BaseException | None


def prefetched(iterator: Iterator[T], depth: int) -> Generator[T]:
    """Yield the items of ``iterator``; up to ``depth`` of them are produced ahead on a thread.

    An exception of the iterator is raised here, at its place. If the consumer stops early (the generator is
    closed or collected), the iterator is closed and the thread has ended on return.

    Args:
        iterator: the iterator, which is consumed on one thread only.
        depth: number of items held ready; 0 or less: no thread.
    """
    if depth <= 0:
        yield from iterator
        return
    ready: queue.Queue[T | _End] = queue.Queue(depth)
    stopped = threading.Event()
    # daemon: a consumer that neither finishes nor closes must not keep the interpreter from exiting
    worker = threading.Thread(target=_produce, args=(iterator, ready, stopped), name="prefetch", daemon=True)
    worker.start()
    try:
        while not isinstance(item := ready.get(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        stopped.set()
        while worker.is_alive():
            _discard(ready)
            worker.join(0.01)


def _produce(iterator: Iterator[T], ready: "queue.Queue[T | _End]", stopped: threading.Event) -> None:
    error: BaseException | None = None
    try:
        for item in iterator:
            if stopped.is_set():
                break
            ready.put(item)
        if stopped.is_set() and hasattr(iterator, "close"):
            iterator.close()
    except BaseException as raised:  # every exception belongs to the consumer
        error = raised
    ready.put(_End(error))


def _discard(ready: "queue.Queue[T | _End]") -> None:
    """Make room, so that a producer that waits in put() notices the stop."""
    try:
        while True:
            ready.get_nowait()
    except queue.Empty:
        pass


@dataclass(frozen=True)
class Reader:
    """One format of recordings."""

    name: str
    """As it stands in ``SequenceInfo.format``."""
    called: str
    """In messages, with what it is recognised by: "a native folder (meta.yaml and scans/)"."""
    recognises: Callable[[Path], bool]
    """Whether an existing path looks like such a recording."""
    open: Callable[[Path, DataConfig], Sequence]
    """Opens it; raises LioJaxError where it is broken."""
    reads: frozenset[str]
    """The fields of DataConfig that change what is read."""
    has_parts: bool = True
    """Whether the paths inside such a recording are parts of it and no recordings themselves."""


def check_still_there(path: Path) -> None:
    """Raise an error if a file cannot be read because its whole folder is gone, as on a lost network drive.

    Args:
        path: of the file of a recording that was open before.

    Raises:
        LioJaxError: the folder is gone.
    """
    try:
        os.stat(path.parent)
    except OSError as error:
        raise LioJaxError(
            f"{path.parent}: is gone while it was read ({error.strerror}); check the disk or the network."
        ) from None


def entries(folder: Path) -> list[Path]:
    """Return what lies in a folder, in order, hidden files left out.

    Raises:
        LioJaxError: the folder cannot be listed.
    """
    try:
        return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise LioJaxError(f"{folder}: cannot be listed ({error.strerror}); check its permissions.") from None
