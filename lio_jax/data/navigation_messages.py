"""Inertial samples and GPS fixes from ROS messages."""

from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.bag_files import cdr_aligned, read_header
from lio_jax.data.enu import geodetic_to_ecef, geodetic_to_enu
from lio_jax.data.gps_checks import with_covariances
from lio_jax.data.sequence import GpsData, ImuData

TYPE = "sensor_msgs/msg/Imu"

_BODY_BYTES = 37 * 8
_ORIENTATION, _GYRO, _ACCEL = slice(0, 32), slice(104, 128), slice(200, 224)


class ImuCollector:
    """Collect serialised Imu messages compactly (an hour at 400 Hz in 130 MB) and turn them into arrays."""

    def __init__(self, ros2: bool) -> None:
        self._ros2 = ros2
        self._order = "<"
        self._stamps = array("q")
        self._values = bytearray()
        self._orientation_covariance = b""

    def add(self, raw: bytes) -> None:
        """Add one message.

        Raises:
            ValueError: the message is shorter than an Imu message.
        """
        header = read_header(raw, self._ros2)
        start = cdr_aligned(header.body, 8) if self._ros2 else header.body
        body = raw[start : start + _BODY_BYTES]
        if len(body) < _BODY_BYTES:
            raise ValueError(f"an Imu message of {len(raw)} bytes is cut short")
        if not self._stamps:
            self._order = header.order
            self._orientation_covariance = body[32:104]
        self._stamps.append(header.stamp_ns)
        self._values += body[_ORIENTATION] + body[_GYRO] + body[_ACCEL]

    def imu(self) -> tuple[ImuData | None, tuple[str, ...]]:
        """Return the samples in time order, with accelerations as recorded, and one sentence for each repair.

        Orientation is kept only where the messages state it: their covariance does not begin with -1, and
        their rotations are neither all zero nor all identity.
        """
        repairs = []
        stamps = np.array(self._stamps, np.int64)
        values = np.frombuffer(bytes(self._values), f"{self._order}f8").reshape(-1, 10).astype(np.float64)
        finite = np.isfinite(values[:, 4:]).all(axis=1)
        if not finite.all():
            repairs.append(f"{np.count_nonzero(~finite)} IMU samples held NaN or infinity and were dropped.")
            stamps, values = stamps[finite], values[finite]
        if np.any(np.diff(stamps) <= 0):
            ordered, first = np.unique(stamps, return_index=True)
            backwards = int(np.count_nonzero(np.diff(stamps) < 0))
            repairs.append(
                f"IMU stamps step back in time {backwards} times and repeat {len(stamps) - len(ordered)} "
                "times: the samples were sorted and repeats dropped."
            )
            stamps, values = ordered, values[first]
        if len(stamps) == 0:
            return None, tuple(repairs)
        return ImuData(stamps, values[:, 4:7], values[:, 7:10], self._orientation(values[:, :4])), tuple(
            repairs
        )

    def _orientation(self, quaternions: NDArray[np.float64]) -> NDArray[np.float64] | None:
        if np.frombuffer(self._orientation_covariance, f"{self._order}f8")[0] == -1.0:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            norms = np.linalg.norm(quaternions, axis=1)
        if not np.all(np.isfinite(norms) & (norms > 0.5)):
            return None
        if np.all(quaternions[:, :3] == 0.0):
            return None
        return quaternions / norms[:, None]


FIX_TYPE = "sensor_msgs/msg/NavSatFix"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"

_FARTHEST_M = 200e3
"""Fixes farther than this from the median fix are no part of a drive, m: receivers may report them first."""


class GpsCollector:
    """Collect deserialised fixes and turn them into arrays."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._positions: list[tuple[float, float, float]] = []
        self._covariances: list[np.ndarray[Any, np.dtype[np.float64]]] = []
        self._geodetic = True
        self._skipped = 0

    def add(self, message: Any) -> None:
        """Add one NavSatFix or Odometry; a message without a position (no fix, NaN, 0/0) is skipped."""
        if hasattr(message, "latitude"):
            position = (message.latitude, message.longitude, message.altitude)
            valid = message.status.status >= 0 and position[:2] != (0.0, 0.0)
            covariance = message.position_covariance.reshape(3, 3)
            if message.position_covariance_type == 0:
                covariance = np.zeros((3, 3))
        else:
            self._geodetic = False
            point = message.pose.pose.position
            position, valid = (point.x, point.y, point.z), True
            covariance = message.pose.covariance.reshape(6, 6)[:3, :3]
        if not (valid and np.isfinite(position).all()):
            self._skipped += 1
            return
        stamp = message.header.stamp
        self._stamps.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
        self._positions.append(position)
        self._covariances.append(np.array(covariance, np.float64))

    def gps(self) -> tuple[GpsData | None, tuple[str, ...]]:
        """Return the fixes in time order, and one sentence for each assumption and each omission."""
        notes = []
        if self._skipped:
            notes.append(f"GPS: {self._skipped} messages without a valid fix were left out")
        if not self._stamps:
            return None, tuple(notes)
        stamps, positions = np.array(self._stamps, np.int64), np.array(self._positions)
        covariances = np.array(self._covariances)
        origin = (float("nan"),) * 3
        if self._geodetic:
            here = _in_one_region(positions)
            if not here.all():
                notes.append(
                    f"GPS: {np.sum(~here)} fixes more than {_FARTHEST_M / 1e3:g} km from the others were "
                    "left out"
                )
            stamps, positions, covariances = stamps[here], positions[here], covariances[here]
            origin = tuple(positions[0].tolist())
            positions = geodetic_to_enu(positions, origin)
        if back := int(np.sum(np.diff(stamps) < 0)):
            notes.append(f"GPS: stamps step back {back} time(s); the fixes were put in order by their stamps")
        stamps, order = np.unique(stamps, return_index=True)
        covariances, unstated = with_covariances(covariances[order])
        if unstated:
            notes.append(f"GPS: {unstated}")
        return GpsData(stamps, positions[order], covariances, origin), tuple(notes)


def _in_one_region(geodetic: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether each fix is near the median fix, so that its tangent plane is level for it, (n,)."""
    places = geodetic_to_ecef(geodetic)
    return np.asarray(np.linalg.norm(places - np.median(places, axis=0), axis=1) < _FARTHEST_M)
