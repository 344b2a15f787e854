"""Turn sensor_msgs/NavSatFix or nav_msgs/Odometry messages into local east-north-up positions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.enu import geodetic_to_ecef, geodetic_to_enu
from lio_jax.data.gps_checks import with_covariances
from lio_jax.data.sequence import GpsData

FIX_TYPE = "sensor_msgs/msg/NavSatFix"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"

_FARTHEST_M = 200e3
"""Fixes farther than this from the middle one are no part of a drive: a receiver's place before it knew."""


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
    """Return (n,) whether fixes are near the middle one, whose tangent plane is level for them."""
    places = geodetic_to_ecef(geodetic)
    return np.asarray(np.linalg.norm(places - np.median(places, axis=0), axis=1) < _FARTHEST_M)
