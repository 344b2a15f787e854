"""This project's own odometry behind the comparison's protocol."""

from collections.abc import Iterator
from functools import cache
from typing import ClassVar

import jax
import numpy as np
from numpy.typing import NDArray
from systems import Pose

from lio_jax.core.settings import Settings, with_extrinsics, with_overrides
from lio_jax.data.sequence import LidarScan
from lio_jax.run.feed import bucket_for
from lio_jax.run.track import CompiledStep, track


class LioJaxSystem:
    """The default recipe; padding, transfer, the step and the result's way back to the host are timed."""

    name: ClassVar[str] = "lio_jax"
    instant: ClassVar[float] = 1.0
    instant_reason: ClassVar[str] = "states live at the scan's end"

    def __init__(self, threads: int, T_imu_lidar: NDArray[np.float64], overrides: tuple[str, ...]) -> None:
        # XLA takes the cores that the process may run on: the script limits those to ``threads``
        jax.config.update("jax_enable_x64", True)
        self._T_imu_lidar = T_imu_lidar
        settings, step = _compiled(T_imu_lidar.tobytes(), overrides)
        self._config = settings.config.lidar
        self._pending: LidarScan
        self._results = track(settings, self._feed(), step=step)

    def warm_up(self, scans: list[LidarScan]) -> None:
        by_bucket = {bucket_for(len(scan.points), self._config): scan for scan in reversed(scans)}
        for scan in [scans[0], *by_bucket.values()]:
            self.register(self.prepare(scan))

    def prepare(self, scan: LidarScan) -> LidarScan:
        return scan

    def register(self, prepared: LidarScan) -> Pose:
        self._pending = prepared
        pose: Pose = next(self._results).T_world_imu @ self._T_imu_lidar
        return pose

    def _feed(self) -> Iterator[LidarScan]:
        while True:
            yield self._pending


@cache
def _compiled(T_imu_lidar: bytes, overrides: tuple[str, ...]) -> tuple[Settings, CompiledStep]:
    """Return settings and the step that every pass over a recording shares, so that it is compiled once."""
    matrix = np.frombuffer(T_imu_lidar, np.float64).reshape(4, 4)
    settings = with_overrides(with_extrinsics(Settings(), matrix, "recording"), overrides)
    return settings, CompiledStep(settings)
