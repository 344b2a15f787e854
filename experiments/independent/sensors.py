"""A spinning LiDAR that Embree casts through the mesh, and an IMU; the noise of both is white and known."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

from independent.motion import Motion
from independent.street import Floats

ELEVATIONS_DEG = {32: (-25.0, 15.0), 16: (-15.0, 15.0)}
"""Lowest and highest beam by number of beams; the beams are equally spaced."""


@dataclass(frozen=True)
class Lidar:
    """A sensor that fires all beams of a column at once and turns once per period, from +x to the left."""

    beams: int = 32
    columns: int = 1024
    period_s: float = 0.1
    range_sigma: float = 0.02
    """Standard deviation of a range, m."""
    dropouts: float = 0.03
    """Share of the returns that are missing at random."""
    min_range: float = 0.8
    max_range: float = 80.0

    def directions(self) -> Floats:
        """Return unit directions in the lidar frame, (columns, beams, 3)."""
        azimuth = 2 * np.pi * (np.arange(self.columns) + 0.5) / self.columns
        elevation = np.deg2rad(np.linspace(*ELEVATIONS_DEG[self.beams], self.beams))
        flat = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)[:, None]
        return flat * np.cos(elevation)[:, None] + np.sin(elevation)[:, None] * np.array([0.0, 0.0, 1.0])

    def times(self) -> Floats:
        """Return the time of each column from the scan's start, (columns,) s."""
        return (np.arange(self.columns) + 0.5) / self.columns * self.period_s


@dataclass(frozen=True)
class Returns:
    """The points of one turn."""

    points: Floats
    """(n, 3) m in the lidar frame at each point's own time."""
    time: Floats
    """(n,) s from the scan's start."""
    ring: NDArray[np.int32]
    """(n,) beams from the lowest."""
    noise: Floats
    """(n,) m that were added to the true ranges."""


class RayCaster:
    """Finds where rays meet a mesh: Embree chooses the triangle, and its plane gives the range in float64."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._embree = RayMeshIntersector(mesh)
        self._corner = np.asarray(mesh.triangles[:, 0], np.float64)
        self._normal = np.cross(*(mesh.triangles[:, k] - mesh.triangles[:, 0] for k in (1, 2)))

    def ranges(self, origins: Floats, directions: Floats) -> Floats:
        """Return the distance to the first triangle along each of (n, 3) unit rays, m; inf without one."""
        triangle = self._embree.intersects_first(origins, directions)
        hit = np.flatnonzero(triangle >= 0)
        normal = self._normal[triangle[hit]]
        towards = np.sum(normal * (self._corner[triangle[hit]] - origins[hit]), axis=1)
        ranges = np.full(len(origins), np.inf)
        ranges[hit] = towards / np.sum(normal * directions[hit], axis=1)
        return ranges


def scan_at(
    start_s: float,
    lidar: Lidar,
    T_imu_lidar: Floats,
    motion: Motion,
    caster: RayCaster,
    rng: np.random.Generator,
) -> Returns:
    """Return one turn; each column is cast from the pose that the sensor has at the column's time."""
    poses = motion.poses(start_s + lidar.times()) @ T_imu_lidar
    local = lidar.directions()
    rays = np.einsum("cij,cbj->cbi", poses[:, :3, :3], local).reshape(-1, 3)
    origins = np.repeat(poses[:, :3, 3], lidar.beams, axis=0)
    true = caster.ranges(origins, rays)
    noise = rng.normal(0.0, lidar.range_sigma, true.shape)
    kept = (true > lidar.min_range) & (true < lidar.max_range) & (rng.random(true.shape) >= lidar.dropouts)
    number = np.flatnonzero(kept)
    return Returns(
        points=(true + noise)[number, None] * local.reshape(-1, 3)[number],
        time=lidar.times()[number // lidar.beams],
        ring=(number % lidar.beams).astype(np.int32),
        noise=noise[number],
    )


@dataclass(frozen=True)
class Imu:
    """A unit with white noise, biases that are drawn once, and random walks of the biases."""

    rate_hz: float = 200.0
    gyro_noise: float = 1e-3
    """Density, rad/s/sqrt(Hz)."""
    accel_noise: float = 1e-2
    """Density, m/s^2/sqrt(Hz)."""
    gyro_bias_walk: float = 0.0
    """Density, rad/s^2/sqrt(Hz)."""
    accel_bias_walk: float = 0.0
    """Density, m/s^3/sqrt(Hz)."""
    gyro_bias_sigma: float = 3e-3
    """Standard deviation of the first bias, rad/s."""
    accel_bias_sigma: float = 3e-2
    """Standard deviation of the first bias, m/s^2."""


@dataclass(frozen=True)
class Samples:
    """Readings of the unit, and the true biases in them."""

    time: Floats
    """(m,) s."""
    gyro: Floats
    accel: Floats
    gyro_bias: Floats
    accel_bias: Floats


def samples_of(motion: Motion, imu: Imu, seconds: float, rng: np.random.Generator) -> Samples:
    """Return the samples from time 0 to ``seconds``, both included."""
    time = np.arange(int(seconds * imu.rate_hz + 1e-6) + 1) / imu.rate_hz

    def biases(sigma: float, walk: float) -> Floats:
        steps = rng.normal(0.0, walk / np.sqrt(imu.rate_hz), (len(time), 3))
        return rng.normal(0.0, sigma, 3) + np.cumsum(steps, axis=0)

    gyro_bias = biases(imu.gyro_bias_sigma, imu.gyro_bias_walk)
    accel_bias = biases(imu.accel_bias_sigma, imu.accel_bias_walk)
    white = np.sqrt(imu.rate_hz) * rng.normal(size=(2, len(time), 3))
    return Samples(
        time=time,
        gyro=motion.angular_rate(time) + gyro_bias + imu.gyro_noise * white[0],
        accel=motion.specific_force(time) + accel_bias + imu.accel_noise * white[1],
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
    )
