"""Decode sensor_msgs/Imu messages in bulk."""

from array import array

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.ros_header import cdr_aligned, read_header
from lio_jax.data.sequence import ImuData

TYPE = "sensor_msgs/msg/Imu"

_BODY_BYTES = 37 * 8
_ORIENTATION, _GYRO, _ACCEL = slice(0, 32), slice(104, 128), slice(200, 224)


class ImuCollector:
    """Gathers serialised Imu messages compactly (an hour at 400 Hz in 130 MB), for arrays at the end."""

    def __init__(self, ros2: bool) -> None:
        self._ros2 = ros2
        self._order = "<"
        self._stamps = array("q")
        self._values = bytearray()
        self._orientation_covariance = b""

    def add(self, raw: bytes) -> None:
        """Take one message.

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
        """Return the samples in time order, accelerometer as recorded, and one sentence for each repair.

        Orientation is kept only where the messages state one: a covariance that does not begin with -1, and
        rotations that are neither all zero nor all identity.
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
        norms = np.linalg.norm(quaternions, axis=1)
        if not np.all(np.isfinite(norms) & (norms > 0.5)):
            return None
        if np.all(quaternions[:, :3] == 0.0):
            return None
        return quaternions / norms[:, None]
