"""Parameters of the LiDAR's measurements, of scan sizes and of features along rings."""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

from lio_jax.core.leaf import leaf, static
from lio_jax.core.types import Scalar

_LARGEST_LIFT = 0.1
"""Bound of a beam's error of elevation, rad; a larger number is one of degrees."""


class LidarParams(eqx.Module):
    """The range measurement, and corrections of the sensor's own calibration."""

    range_sigma: Scalar = leaf(0.045, "m", above=0, tuned="log")
    """Standard deviation of a range. Where ``surface_sigma`` is zero or absent it stands for the whole
    distance of a point from its surface, the surface's roughness included."""
    min_range: Scalar = leaf(2.0, "m", least=0)
    """Nearer points are dropped."""
    max_range: Scalar = leaf(100.0, "m", above=0)
    """Farther points are dropped."""
    elevation_offset: Scalar = leaf(
        0.0, "rad", least=-_LARGEST_LIFT, most=_LARGEST_LIFT, tuned="linear", moves_points=True
    )
    """Angle that is added to the elevation of each point above the sensor's xy-plane; azimuth and range
    stay."""
    range_offset: Scalar = leaf(0.0, "m", tuned="linear", moves_points=True)
    """Length that is added to each range, after the scale."""
    range_scale: Scalar = leaf(1.0, above=0, tuned="log", moves_points=True)
    """Factor of each range."""
    ring_elevation_offset: Float[Array, " lifted"] = leaf(
        (), "rad", least=-_LARGEST_LIFT, most=_LARGEST_LIFT, tuned="linear", per_ring=True, moves_points=True
    )
    """Angle that is added to the elevation of the points of each ring as well: one number per ring, from ring
    0 on. Rings beyond the last number have none."""
    ring_range_offset: Float[Array, " lengthened"] = leaf(
        (), "m", tuned="linear", per_ring=True, moves_points=True
    )
    """Length that is added to the ranges of each ring as well: one number per ring, from ring 0 on. Rings
    beyond the last number have none."""

    def corrected(self, points: Float[Array, "n 3"], ring: Int32[Array, " n"]) -> Float[Array, "n 3"]:
        """Return points with these corrections of elevation and range; without any they stay as they are.

        A point on the z axis has no azimuth in which to be raised: its direction stays.

        Args:
            points: m, lidar frame at each point's own firing time; finite.
            ring: number of the ring of each point; negative where it is not known.
        """
        kind = points.dtype
        lift = _of_each(self.elevation_offset, self.ring_elevation_offset, ring).astype(kind)
        longer = _of_each(self.range_offset, self.ring_range_offset, ring).astype(kind)
        cosine, sine = jnp.cos(lift), jnp.sin(lift)
        x, y, z = points.T
        level_squared = x**2 + y**2
        level, has_azimuth = _root(level_squared)
        distance, _ = _root(level_squared + z**2)
        stretch = self.range_scale.astype(kind) + longer / distance
        inward = jnp.where(has_azimuth, cosine - sine * z / level, 1.0)
        raised = jnp.where(has_azimuth, z * cosine + sine * level, z)
        return jnp.stack([x * inward, y * inward, raised], -1) * stretch[:, None]


def _of_each(common: Scalar, by_ring: Float[Array, " rings"], ring: Int32[Array, " n"]) -> Array:
    """Return the sum of a number for all points and of that for their rings, where there is one."""
    rings = len(by_ring)
    if not rings:
        return common
    known = (ring >= 0) & (ring < rings)
    return common + jnp.where(known, by_ring[jnp.clip(ring, 0, rings - 1)], 0.0)


def _root(squared: Float[Array, " n"]) -> tuple[Array, Array]:
    """Return the root, or 1 with a derivative of zero where there is none, and whether there is one."""
    positive = squared > 0
    return jnp.sqrt(jnp.where(positive, squared, 1.0)), positive


class BeamParams(LidarParams):
    """The range measurement with a separate roughness of surfaces and a beam direction error."""

    surface_sigma: Scalar = leaf(0.0, "m", least=0, tuned="log")
    """Standard deviation of a surface from the plane of its voxel, beyond the scatter of the voxel's
    points."""
    angle_sigma: Scalar = leaf(0.0, "rad", least=0, tuned="log")
    """Standard deviation of a beam's direction. It matters at long range and grazing incidence."""


class FeatureParams(eqx.Module):
    """Which points are corners and which are flat (Zhang & Singh, LOAM, RSS 2014, section V.A)."""

    corner_threshold: Scalar = leaf(0.1, "m^2", above=0)
    """Corners have a smoothness above this."""
    flat_threshold: Scalar = leaf(0.1, "m^2", above=0)
    """Flat points have a smoothness below this."""
    surface_spacing: Scalar = leaf(0.2, "m", above=0)
    """Surface points are averaged per ring and cube of this edge length."""


class LoamFeatureParams(FeatureParams):
    """Features as A-LOAM picks them."""

    connected_distance: Scalar = leaf(0.05**0.5, "m", above=0)
    """A picked point suppresses its neighbours along the ring as long as consecutive points are no farther
    apart than this."""


class LioSamFeatureParams(FeatureParams):
    """Features as LIO-SAM picks them."""

    connected_columns: Scalar = leaf(10.0, "columns", above=0)
    """A picked point suppresses its neighbours along the ring as long as consecutive points are no more
    columns apart than this."""
    occlusion_step: Scalar = leaf(0.3, "m", above=0)
    """Points behind an edge whose range differs by more than this are not features."""
    occlusion_columns: Scalar = leaf(10.0, "columns", above=0)
    """The occlusion test applies where the edge's two points are fewer columns apart than this."""
    parallel_ratio: Scalar = leaf(0.02, above=0)
    """A point is not a feature if its range differs from both neighbours' by more than this share of it."""


@dataclass(frozen=True)
class ScanConfig:
    """Padded sizes of scans."""

    buckets: tuple[int, ...] = static((4096, 8192, 16384, 32768, 65536, 98304, 131072, 196608, 262144))
    """Padded numbers of points. A scan takes the smallest size that holds it; a larger scan is thinned to the
    largest size."""


@dataclass(frozen=True)
class RingConfig:
    """Sizes of the sensor's rings and of the features along them."""

    rings: int = static(64, least=0)
    """Number of rings of the sensor. Points of a ring beyond it are reported as dropped. 0: taken from the
    first scans of the recording."""
    ring_step: int = static(1, above=0)
    """One ring of so many is used."""
    columns: int = static(2304, least=0)
    """Number of columns of a full turn where points are ordered by azimuth, else the number of points that a
    ring has room for. 0: taken from the first scans of the recording."""
    order: Literal["arrival", "azimuth"] = static("arrival")
    """Order of a ring's points: as the recording has them (A-LOAM, and the lines of a Livox), or by columns
    of equal azimuth, of which the first point takes each (LIO-SAM)."""
    neighbours: int = static(5, above=0)
    """Points on either side that make up the smoothness of a point and that a picked point suppresses. As
    many points stay unused at both ends of a ring."""
    sectors: int = static(6, above=0)
    """Number of sectors of a ring. Features are picked in one sector after another."""
    corners: int = static(20, above=0)
    """Largest number of corners of a sector."""
    surface_points: int = static(49152, least=0)
    """Capacity of the downsampled surface points. 0: taken from the first scans of the recording."""


@dataclass(frozen=True)
class LoamRingConfig(RingConfig):
    """Sizes with LOAM's two classes of corners and of flat points."""

    sharp: int = static(2, above=0)
    """Number of sharpest corners of a sector, which are matched against the less sharp ones."""
    flat: int = static(4, above=0)
    """Number of flattest points of a sector, which are matched against the surfaces."""


@runtime_checkable
class ReadsFeatures(Protocol):
    """A recipe's parameters, as far as the features of any kind read them."""

    @property
    def lidar(self) -> LidarParams:
        """The range measurement."""
        ...

    @property
    def features(self) -> FeatureParams:
        """Which points are corners and which are flat."""
        ...


@runtime_checkable
class ReadsLoamFeatures(ReadsFeatures, Protocol):
    """A recipe's parameters, as far as A-LOAM's features read them."""

    @property
    def features(self) -> LoamFeatureParams:
        """Which points are corners and which are flat."""
        ...


@runtime_checkable
class ReadsLioSamFeatures(ReadsFeatures, Protocol):
    """A recipe's parameters, as far as LIO-SAM's features read them."""

    @property
    def features(self) -> LioSamFeatureParams:
        """Which points are corners and which are flat."""
        ...


@runtime_checkable
class ReadsRings(Protocol):
    """A recipe's static settings, as far as the features read them."""

    @property
    def features(self) -> RingConfig:
        """Sizes of the rings and of the features along them."""
        ...


@runtime_checkable
class ReadsLoamRings(ReadsRings, Protocol):
    """A recipe's static settings, as far as A-LOAM's features read them."""

    @property
    def features(self) -> LoamRingConfig:
        """Sizes of the rings and of the features along them."""
        ...
