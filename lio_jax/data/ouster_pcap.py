"""Read packet captures of Ouster lidars, with the IMU in them, by the vendor's library ouster-sdk."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, one_line
from lio_jax.core.timestamps import FARTHEST_NS
from lio_jax.data.cloud_fields import valid_returns
from lio_jax.data.config import DataConfig
from lio_jax.data.pcap_file import SUFFIXES, datagrams, first_datagrams, unknown_capture
from lio_jax.data.sequence import ImuData, LidarScan, Reader, SequenceBase, SequenceInfo, scans_from
from lio_jax.data.time_order import Stamped, in_time_order
from lio_jax.data.trajectory import are_rigid

INSTALL = "pip install --no-deps 'ouster-sdk>=1.0'"
"""Command that installs the library: its dependencies contradict ours, and captures are read without them."""

_PORTS = frozenset({7502, 7503})
"""UDP ports to which an Ouster sends unless it is told otherwise."""
_VALID = 1
"""Bit of the status of a column or of an inertial sample that was measured."""
_LONGEST_NS = 500_000_000
"""Longest time between two columns of a frame, ns; the slowest rate is 5 Hz."""
_FRAMES_LOOKED_AT = 8
_YEAR_2000_NS = 946_684_800_000_000_000
_INTENSITY = ("SIGNAL", "REFLECTIVITY")
"""Fields that are read as intensity: the first one that the sensor sends. Every profile has one of them."""


class OusterPcap(SequenceBase):
    """A capture of one Ouster, with the file of its metadata beside it.

    The sentences of a GPS receiver at the sensor are not read.
    """

    def __init__(self, path: Path, config: DataConfig) -> None:
        """Find the metadata and the frames.

        Args:
            path: path of the capture.
            config: not used, because packets and metadata state everything.

        Raises:
            LioJaxError: the capture holds no frames of the sensor that the metadata describe, there are no
                metadata, or the library is not installed.
        """
        super().__init__()
        self._path = path
        # the library says nothing of a capture that is truncated, damaged or none at all
        if not sum(1 for _ in datagrams(path, self._log.add)):
            raise unknown_capture(path)
        described = _metadata_files(path)
        if not described:
            raise _without_metadata(path)
        self._sdk = _library(path)
        self._metadata, self._sensor = self._described(described)
        self._frames = self._opened()
        self._project = self._sdk.core.XYZLut(self._sensor, use_extrinsics=False)
        first = next(self._scans(0, _FRAMES_LOOKED_AT), None)
        if first is None:
            raise LioJaxError(f"{path}: its first frames hold no measured column; record the sensor at work.")
        clock = [] if first.stamp_ns > _YEAR_2000_NS else ["stamps: the time since the sensor's start"]
        self.info = SequenceInfo(
            name=path.stem,
            format="ouster_pcap",
            path=str(path),
            scan_count=len(self._frames),
            T_imu_lidar=self._extrinsic(),
            sensor=f"Ouster {self._sensor.prod_line}",
            notes=(
                f"packets of an Ouster {self._sensor.prod_line}, with the metadata of {self._metadata.name}",
                "points in the sensor's frame; T_imu_lidar is that of the metadata",
                *clock,
            ),
        )

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield frames ``start`` to ``start + count``; one with a wrong stamp is left out with a warning."""
        yield from in_time_order(self._scans(start, count), self._log.add)

    def imu(self) -> ImuData | None:
        """Return the samples of the sensor's own IMU, or None where none were recorded."""
        return self._imu

    def _scans(self, start: int, count: int | None) -> Iterator[Stamped[LidarScan]]:
        numbers = range(len(self._frames))[scans_from(start, count)]
        if not numbers:
            return
        # frames share one reader, so each pass needs its own; after a jump the library loses the first packet
        # of a frame if it came in fragments
        before = max(start - 1, 0)
        for number, frames in enumerate(self._opened()[before : numbers.stop], before):
            if number < start:
                continue
            name = f"{self._path.name}: scan {number}"
            scan = None if frames[0] is None else self._scan(frames[0])
            if scan is None:
                self._log.add(f"{name} holds no measured column and was skipped.")
                continue
            yield Stamped(scan.stamp_ns, name, scan)

    def _scan(self, frame: Any) -> LidarScan | None:
        measured = np.flatnonzero((frame.status & _VALID) & (frame.timestamp < FARTHEST_NS))
        if not len(measured):
            return None
        stamps = frame.timestamp[measured].astype(np.int64)
        # a damaged stamp of one column must not stretch the frame
        near = np.abs(stamps - np.median(stamps).astype(np.int64)) < _LONGEST_NS
        measured, stamps = measured[near], stamps[near]
        start_ns = int(stamps.min())
        # the frame lasts until the next column would be measured
        columns = max(int(measured[-1] - measured[0]), 1)
        duration_ns = int(stamps.max()) - start_ns
        duration_ns += duration_ns // columns
        ranges = frame.field("RANGE")[:, measured]
        intensity = frame.field(next(name for name in _INTENSITY if name in frame.fields))
        # column by column, as the sensor fires
        column, ring = np.nonzero(ranges.T)
        with np.errstate(over="ignore"):
            points = self._project(frame)[ring, measured[column]].astype(np.float32)
        # the angles and lengths of damaged metadata may be anything
        kept = valid_returns(points)
        if not kept.all():
            points, column, ring = points[kept], column[kept], ring[kept]
        return LidarScan(
            stamp_ns=start_ns,
            points=points,
            time=((stamps - start_ns) * 1e-9).astype(np.float32)[column],
            ring=ring.astype(np.int32),
            intensity=intensity[ring, measured[column]].astype(np.float32),
            duration=duration_ns * 1e-9,
            dropped=ranges.size - len(ring),
        )

    @cached_property
    def _imu(self) -> ImuData | None:
        stamps, gyro, accel = [], [], []
        packets = self._sdk.open_packet_source(str(self._path), meta=[str(self._metadata)])
        for _, packet in packets:
            if isinstance(packet, self._sdk.core.ImuPacket):
                # newer packets hold several samples
                measured = packet.status() & _VALID > 0
                stamps.append(packet.timestamp()[measured])
                # the library gives rad/s and m/s^2
                gyro.append(packet.gyro()[measured])
                accel.append(packet.accel()[measured])
        if not stamps:
            return None
        return ImuData(
            np.concatenate(stamps).astype(np.int64),
            np.concatenate(gyro).astype(np.float64),
            np.concatenate(accel).astype(np.float64),
        )

    def _described(self, files: list[Path]) -> tuple[Path, Any]:
        """Return the first file of metadata that can be read, and what it describes."""
        failed = ""
        for file in files:
            try:
                return file, self._sdk.core.SensorInfo(file.read_text(encoding="utf-8"))
            # the library raises exceptions of many kinds on other files
            except Exception as error:
                failed = failed or f"{file}: is no metadata of an Ouster ({one_line(str(error))})"
        raise LioJaxError(f"{failed}; put the metadata of {self._path.name} in its place.")

    def _extrinsic(self) -> NDArray[np.float64]:
        """Return the pose of the sensor's frame in that of its IMU, (4, 4) m."""
        T_sensor_imu = np.eye(4)
        T_sensor_imu[:3] = self._sensor.imu_to_sensor_transform[:3]
        if not are_rigid(T_sensor_imu[None]).all():
            raise LioJaxError(
                f"{self._metadata}: imu_to_sensor_transform is no rotation with a translation; put the "
                f"metadata of {self._path.name} in its place."
            )
        T_sensor_imu[:3, 3] *= 1e-3
        return np.asarray(np.linalg.inv(T_sensor_imu), np.float64)

    def _opened(self) -> Any:
        try:
            frames = self._sdk.open_source(
                str(self._path), meta=[str(self._metadata)], sensor_idx=0, collate=False, index=True
            )
        except Exception as error:
            raise LioJaxError(
                f"{self._path}: cannot be read with the metadata of {self._metadata.name} "
                f"({one_line(str(error))}); check that they belong together."
            ) from None
        if not len(frames):
            raise unknown_capture(self._path, f", or {self._metadata.name} is the metadata of another sensor")
        return frames


def _metadata_files(path: Path) -> list[Path]:
    """Return the .json files beside a capture, the one with the most similar name first."""
    found = (file for file in path.parent.glob("*.json") if file.is_file())
    return sorted(found, key=lambda file: (-_equal_letters(file.stem, path.stem), file.name))


def _without_metadata(path: Path) -> LioJaxError:
    if _PORTS.isdisjoint(one.port for one in first_datagrams(path)):
        return unknown_capture(path, f" ({path.stem}.json, which is not there)")
    return LioJaxError(
        f"{path}: is the capture of an Ouster, which cannot be read without the sensor's metadata; put the "
        f".json file that was written with the capture beside it, as {path.stem}.json."
    )


def _equal_letters(one: str, other: str) -> int:
    """Return the number of letters with which both names begin."""
    return next((place for place, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), len(one))


def _library(path: Path) -> Any:
    try:
        from ouster import sdk

        # before version 1.0 frames had another name
        from ouster.sdk.core import LidarFrame  # noqa: F401
    except ImportError:
        raise LioJaxError(
            f"{path}: captures of an Ouster are decoded by ouster-sdk 1.0 or newer, which is not installed; "
            f"install it with {INSTALL}."
        ) from None
    return sdk


READER = Reader(
    "ouster_pcap",
    "a packet capture of an Ouster (.pcap with its metadata .json)",
    lambda path: path.is_file() and path.suffix.lower() in SUFFIXES,
    OusterPcap,
    reads=frozenset(),
    has_parts=False,
)
"""It takes every capture that no reader before it takes, and names what is wrong with that."""
