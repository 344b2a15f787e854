"""A short simulated drive in double precision, and settings under which solves converge to the last digit."""

from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np

from lio_jax.run.run import settings_for
from lio_jax.run.scan_inputs import ScanInput
from lio_jax.settings.settings import Settings, declared_settings, recipe_settings, with_overrides
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from lio_jax.tuning.recording import Recording
from tests.params import DEFAULTS

SCANS = 20
SMALL = [
    "config.lidar.buckets=[4096]",
    "config.lidar.registration_points=1024",
    "config.lidar.insertion_points=4096",
    "config.imu.buckets=[64]",
    "config.imu.registration_points=1024",
    "config.imu.insertion_points=4096",
    "config.map.capacity=32768",
    "config.lio_sam.window=4",
    "config.lio_sam.keyframes=8",
    "config.lio_sam.corner_points=512",
    "config.lio_sam.surface_points=1024",
]
TIGHT = [
    "config.registration.max_iterations=60",
    "params.registration.rotation_tolerance=1e-12",
    "params.registration.translation_tolerance=1e-12",
    "config.lio_sam.smoother_iterations=30",
    "params.smoother.tolerance=1e-10",
]


@cache
def drive(world: str = "street", beams: int = 16, columns: int = 256) -> SimulatedSequence:
    """Return a drive that has begun before the first scan."""
    T_imu_lidar = np.eye(4)
    # away from the borders of the map's grid
    T_imu_lidar[:3, 3] = 0.06, 0.03, 0.25
    return SimulatedSequence(
        world,
        duration_s=SCANS * 0.1,
        beams=beams,
        columns=columns,
        seed=3,
        imu=ImuModel(),
        moving_start=True,
        T_imu_lidar=T_imu_lidar,
    )


def settings(recipe: str, inertial: bool, *more: str, of: SimulatedSequence | None = None) -> Settings:
    """Return a recipe's settings for a drive with a small program and every sigma above zero."""
    section = DEFAULTS["initial"]
    positive = [f"params.initial.{name}={value or 0.01}" for name, value in section.items()]
    # samples and scans of a simulation share their instants, where the sampling has a kink
    offset = "params.extrinsics.time_offset=0.0013"
    overrides = [
        *SMALL,
        *positive,
        offset,
        "params.lidar.angle_sigma=0.001",
        "params.lidar.surface_sigma=0.02",
        "params.lidar.ring_elevation_offset=[0.0, 0.001, -0.002]",
        "params.lidar.ring_range_offset=[0.02, -0.01]",
        *more,
    ]
    if not inertial:
        overrides.append("config.imu.use=false")
    read = declared_settings(recipe)
    overrides = [one for one in overrides if one.partition("=")[0] in read]
    return settings_for(of or drive(), with_overrides(recipe_settings(recipe), overrides))[0]


class DoubleRecording(Recording):
    """Scans whose points are held in double precision."""

    def scan_inputs(self):
        for fed in super().scan_inputs():
            scan = replace(
                fed.scan,
                points=np.asarray(fed.scan.points, np.float64),
                time=np.asarray(fed.scan.time, np.float64),
                duration=jnp.float64(fed.scan.duration),
                interval=jnp.float64(fed.scan.interval),
            )
            yield ScanInput(**{**vars(fed), "scan": scan})
