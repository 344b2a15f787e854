"""Recordings whose set-up is wrong: extrinsic, clock, axes of the IMU, scan period."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.data.sequence import ImuData, LidarScan, Sequence
from lio_jax.data.trajectory import Trajectory


class Faulty:
    """A recording with a wrong set-up."""

    def __init__(
        self,
        sequence: Sequence,
        turn: Rotation | None = None,
        move: tuple[float, float, float] = (0.0, 0.0, 0.0),
        late_s: float = 0.0,
        axes: NDArray | None = None,
        gyro: tuple[float, float, float] = (1.0, 1.0, 1.0),
        sweep: float = 1.0,
    ) -> None:
        """Change a recording.

        Args:
            sequence: the right one.
            turn: of the extrinsic.
            move: of the extrinsic, m.
            late_s: added to the inertial stamps.
            axes: (3, 3) turn of the inertial samples.
            gyro: factors of the gyroscope's axes.
            sweep: factor of the points' times.
        """
        T_imu_lidar = np.array(sequence.info.T_imu_lidar)
        if turn is not None:
            T_imu_lidar[:3, :3] = T_imu_lidar[:3, :3] @ turn.as_matrix()
        T_imu_lidar[:3, 3] += move
        self.info = replace(sequence.info, T_imu_lidar=T_imu_lidar)
        self.warnings_so_far = ()
        self._sequence, self._late_s, self._sweep = sequence, late_s, sweep
        self._axes, self._gyro = np.eye(3) if axes is None else axes, np.array(gyro)

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield the scans, their sweeps stretched."""
        for scan in self._sequence.scans(start, count):
            yield self.changed(scan)

    def changed(self, scan: LidarScan) -> LidarScan:
        """Return a scan with its sweep stretched."""
        return replace(scan, time=scan.time * self._sweep, duration=scan.duration * self._sweep)

    def imu(self) -> ImuData:
        """Return the samples, changed."""
        imu = self._sequence.imu()
        return replace(
            imu,
            stamp_ns=imu.stamp_ns + round(self._late_s * 1e9),
            gyro=imu.gyro * self._gyro @ self._axes.T,
            accel=imu.accel @ self._axes.T,
        )

    def gps(self) -> None:
        """Return None."""

    def truth(self) -> Trajectory:
        """Return the truth of the right recording."""
        return self._sequence.truth()


SET_UPS: dict[str, dict[str, Any]] = {
    "rotation 10 deg about x": {"turn": Rotation.from_euler("x", 10, degrees=True)},
    "rotation 5 deg about z": {"turn": Rotation.from_euler("z", 5, degrees=True)},
    "translation 0.5 m": {"move": (0.5, 0.0, 0.0)},
    "clock 50 ms late": {"late_s": 0.05},
    "clock 30 ms early": {"late_s": -0.03},
    "IMU turned by 90 deg": {"axes": Rotation.from_euler("z", 90, degrees=True).as_matrix()},
    "gyroscope's z has the wrong sign": {"gyro": (1.0, 1.0, -1.0)},
    "gyroscope at half its rates": {"gyro": (0.5, 0.5, 0.5)},
    "sweeps of twice the length": {"sweep": 2.0},
    "8 beams": {},
}
"""Arguments of :class:`Faulty`."""
