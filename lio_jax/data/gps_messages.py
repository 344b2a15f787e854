"""Turn sensor_msgs/NavSatFix or nav_msgs/Odometry messages into local east-north-up positions."""

from typing import Any

import numpy as np

from lio_jax.data.enu import geodetic_to_enu
from lio_jax.data.sequence import GpsData

FIX_TYPE = "sensor_msgs/msg/NavSatFix"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"

_UNSTATED_SIGMA = (5.0, 5.0, 10.0)
"""m, east north up: of a plain receiver, where the messages state no covariance."""


class GpsCollector:
    """Gathers deserialised fixes and turns them into arrays once."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._positions: list[tuple[float, float, float]] = []
        self._covariances: list[np.ndarray[Any, np.dtype[np.float64]]] = []
        self._geodetic = True
        self._skipped = 0

    def add(self, message: Any) -> None:
        """Take one NavSatFix or Odometry; fixes without a position (no fix, NaN, 0/0) are skipped."""
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
        """Return the positions in time order and one sentence for each thing that was assumed or left out."""
        notes = []
        if self._skipped:
            notes.append(f"GPS: {self._skipped} messages without a valid fix were left out")
        if not self._stamps:
            return None, tuple(notes)
        stamps, order = np.unique(np.array(self._stamps, np.int64), return_index=True)
        positions = np.array(self._positions)
        covariances = np.array(self._covariances)[order]
        unstated = ~(np.diagonal(covariances, axis1=1, axis2=2) > 0).all(axis=1)
        if unstated.any():
            covariances[unstated] = np.diag(np.square(_UNSTATED_SIGMA))
            notes.append(
                f"GPS: {np.count_nonzero(unstated)} of {len(stamps)} fixes state no covariance: "
                "5 m horizontally and 10 m vertically were assumed"
            )
        origin = (float("nan"),) * 3
        if self._geodetic:
            origin = self._positions[0]
            positions = geodetic_to_enu(positions, origin)
        return GpsData(stamps, positions[order], covariances, origin), tuple(notes)
