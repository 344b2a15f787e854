"""This project's own odometry behind the comparison's protocol."""

from collections.abc import Iterator
from functools import cache
from typing import ClassVar

import jax
import numpy as np
from numpy.typing import NDArray
from systems import Pose

from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.lidar.params import RingConfig
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.fitted_settings import (
    with_inertial_noise,
    with_range_noise,
    with_sensor_sizes,
)
from lio_jax.run.run import imu_feed
from lio_jax.run.scan_inputs import bucket_for
from lio_jax.run.track import pose_matrix, run_steps, scan_inputs
from lio_jax.settings.settings import Settings, recipe_settings, with_extrinsics, with_overrides

_OPENING = 3
"""Scans in which every program of a drive has been compiled once: init and step."""


class LioJaxSystem:
    """A recipe; padding, transfer, the step and the return of the result to the host are timed."""

    name: ClassVar[str] = "lio_jax"
    instant: ClassVar[float] = 1.0
    instant_reason: ClassVar[str] = "states live at the scan's end"

    def __init__(
        self,
        threads: int,
        T_imu_lidar: NDArray[np.float64],
        overrides: tuple[str, ...],
        inertial: Sequence | None = None,
        recipe: str = "default",
    ) -> None:
        """Make a system without any scan.

        Args:
            threads: not used here; part of the interface.
            T_imu_lidar: (4, 4) pose of the lidar in the IMU frame.
            overrides: settings as ``path=value``.
            inertial: recording with the inertial samples to use; None: LiDAR only.
            recipe: recipe whose settings apply unless ``overrides`` replaces them.
        """
        # XLA takes the cores on which the process may run: the script limits those to ``threads``
        jax.config.update("jax_enable_x64", True)
        self._T_imu_lidar = T_imu_lidar
        settings, step = _compiled(T_imu_lidar.tobytes(), recipe, overrides)
        self._config = settings.config.lidar
        self._begun = False
        self._pending: list[LidarScan] = []
        self._waiting: list[LidarScan] = []
        self.estimates: list[tuple[int, Pose]] = []
        """Start stamp and pose of each scan that was answered: the first one with the second."""
        imu = imu_feed(inertial, settings)[0] if inertial is not None else None
        self._results = run_steps(step, scan_inputs(settings, self._feed(), imu))

    def warm_up(self, scans: list[LidarScan]) -> None:
        sizes: set[int] = set()
        for number, scan in enumerate(scans):
            size = bucket_for(len(scan.points), self._config)
            if number < _OPENING or size not in sizes:
                self.register(self.prepare(scan))
            sizes.add(size)

    def prepare(self, scan: LidarScan) -> LidarScan:
        return scan

    def register(self, prepared: LidarScan) -> Pose:
        """Return the latest pose; the first scan, whose result waits for the second, has none yet."""
        self._pending.append(prepared)
        self._waiting.append(prepared)
        if len(self._waiting) == 1 and not self._begun:
            self._begun = True
            return np.eye(4)
        while self._waiting:
            _, state, _ = next(self._results)
            pose: Pose = pose_matrix(np.asarray(state.nav.T_world_imu.wxyz_xyz)) @ self._T_imu_lidar
            self.estimates.append((self._waiting.pop(0).stamp_ns, pose))
        return pose

    def _feed(self) -> Iterator[LidarScan]:
        while True:
            yield self._pending.pop(0)


def sizes_for(recipe: str, scans: list[LidarScan]) -> tuple[str, ...]:
    """Return as overrides the sizes that a recipe leaves open and the scans determine."""
    settings = recipe_settings(recipe)
    if not isinstance(getattr(settings.config, "features", None), RingConfig):
        return ()
    fitting = with_sensor_sizes(settings, scans)[0].config.features
    return tuple(
        f"config.features.{name}={value}"
        for name, value in vars(fitting).items()
        if value != getattr(settings.config.features, name)
    )


def noise_for(recipe: str, sequence: Sequence) -> tuple[str, ...]:
    """Return as overrides the noise of the sensors that a recipe takes from the recording."""
    fitted = with_inertial_noise(sequence, recipe_settings(recipe))[0]
    fitted = with_range_noise(fitted, sequence.scans())[0]
    # loam has no inertial samples
    densities = ("gyro_noise", "accel_noise") if "imu" in fitted.values else ()
    inertial = (f"params.imu.{name}={fitted.values['imu'][name]}" for name in densities)
    return (*inertial, f"params.lidar.range_sigma={fitted.values['lidar']['range_sigma']}")


@cache
def _compiled(T_imu_lidar: bytes, recipe: str, overrides: tuple[str, ...]) -> tuple[Settings, CompiledStep]:
    """Return settings and the step that all passes over a recording share, so that it is compiled once."""
    matrix = np.frombuffer(T_imu_lidar, np.float64).reshape(4, 4)
    settings = with_overrides(with_extrinsics(recipe_settings(recipe), matrix, "recording"), overrides)
    # a scan comes with register(): none can be read ahead
    settings = with_overrides(settings, ["config.data.prefetch=0"])
    return settings, CompiledStep(settings)
