"""Corners and flat points along the rings of a scan: the front ends of LOAM and LIO-SAM.

    scan -> range image -> smoothness, masks -> picks, sector by sector -> corners, flat points
                                                   \\-> all other points -> mean per ring and voxel

The indices have no derivative. The points that they gather, and the means, have one. The clouds can be
thinned further for a map, by the mean per voxel.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.errors import UsageError
from lio_jax.core.types import Scan
from lio_jax.core.xla import computed_once
from lio_jax.lidar.params import (
    LidarParams,
    ReadsFeatures,
    ReadsLioSamFeatures,
    ReadsLoamFeatures,
    ReadsLoamRings,
    ReadsRings,
)
from lio_jax.lidar.picking import (
    Picks,
    Ring,
    after_each,
    occluded,
    parallel_to_beam,
    pick,
    point_smoothness,
    range_smoothness,
    reach,
    sector_bounds,
)
from lio_jax.lidar.range_image import RangeImage, range_image
from lio_jax.lidar.thinning import mean_per_ring_and_voxel, mean_per_voxel


class FeatureCloud(eqx.Module):
    """Points of one kind, padded to n."""

    points: Float[Array, "n 3"]
    """Coordinates in the lidar frame at the firing time of each point, m."""
    time: Float[Array, " n"]
    """Firing time from the scan's start, s."""
    ring: Int32[Array, " n"]
    """Beam index; 0 where the cloud has no rings."""
    mask: Bool[Array, " n"]
    """True where a point is real, False on padding."""


class LoamFeatures(eqx.Module):
    """The result of A-LOAM's scan registration."""

    sharp: FeatureCloud
    """The sharpest corners of each sector."""
    less_sharp: FeatureCloud
    """More corners of each sector, those of ``sharp`` included."""
    flat: FeatureCloud
    """The flattest points of each sector."""
    less_flat: FeatureCloud
    """All points that are not in ``less_sharp``, averaged per ring and voxel."""
    dropped: Int32[Array, ""]
    """Number of points, and of rows of ``less_flat``, beyond the capacities."""


class LioSamFeatures(eqx.Module):
    """The result of LIO-SAM's feature extraction."""

    corner: FeatureCloud
    """The sharpest points of each sector."""
    surface: FeatureCloud
    """All points that are not corners, averaged per ring and voxel."""
    dropped: Int32[Array, ""]
    """Number of points, and of rows of ``surface``, beyond the capacities."""


class Rings(eqx.Module):
    """A scan along its rings, with the smoothness and the masks of its points."""

    image: RangeImage
    """Which point of the scan is at each place along the rings."""
    xyz: tuple[Float32[Array, "k rings"], Float32[Array, "k rings"], Float32[Array, "k rings"]]
    """Coordinates x, y and z in the lidar frame, m; zero where there is no point."""
    time: Float32[Array, "k rings"]
    """Firing time from the scan's start, s; zero where there is no point."""
    ring: Ring
    """Smoothness of each point, and which points may be picked."""
    bounds: Int32[Array, "bounds rings"]
    """Place along each ring where each sector starts, and where the last one ends."""


def check_sizes(config: ReadsRings) -> None:
    """Check that no size of ``config.features`` is left to be chosen from the recording.

    Raises:
        UsageError: the number of rings, columns or surface points is 0.
    """
    features = config.features
    if not (features.rings and features.columns and features.surface_points):
        raise UsageError(
            "config.features.rings, columns and surface_points are 0, for by the recording; "
            "take the settings from settings_for(sequence, settings), or set them."
        )


def loam_features(config: ReadsLoamRings, params: ReadsLoamFeatures, scan: Scan) -> LoamFeatures:
    """Pick LOAM's features.

    Source: Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014, section V.A, in the form
    of A-LOAM.

    Args:
        config: ``config.features``.
        params: ``params.features`` and the range limits of ``params.lidar``.
        scan: padded sweep.
    """
    rings = loam_rings(config, params, scan)
    picks = _picked(config, params, rings, config.features.flat)
    less_flat, dropped = _surface(config, params, rings, picks)
    return LoamFeatures(
        sharp=_cloud(scan, rings, picks.corners[: config.features.sharp]),
        less_sharp=_cloud(scan, rings, picks.corners),
        flat=_cloud(scan, rings, picks.flats),
        less_flat=less_flat,
        dropped=rings.image.dropped + dropped,
    )


def lio_sam_features(config: ReadsRings, params: ReadsLioSamFeatures, scan: Scan) -> LioSamFeatures:
    """Pick LIO-SAM's features.

    Source: Shan et al., "LIO-SAM: Tightly-coupled lidar inertial odometry via smoothing and mapping", IROS
    2020, section III.C, in the form of its program: flat points are picked, but they only suppress corners
    near them.

    Args:
        config: ``config.features``, with ``order="azimuth"`` unless the rings are the lines of a Livox.
        params: ``params.features`` and the range limits of ``params.lidar``.
        scan: padded sweep.
    """
    rings = lio_sam_rings(config, params, scan)
    picks = _picked(config, params, rings, None)
    surface, dropped = _surface(config, params, rings, picks)
    return LioSamFeatures(
        corner=_cloud(scan, rings, picks.corners), surface=surface, dropped=rings.image.dropped + dropped
    )


def loam_rings(config: ReadsRings, params: ReadsLoamFeatures, scan: Scan) -> Rings:
    """Return the scan's rings with the smoothness of the points in 3-D; every point may be picked.

    Suppression ends where consecutive points are farther apart than ``connected_distance``. This replaces the
    paper's tests for occlusion and for surfaces along the beam.

    Args:
        config: ``config.features``.
        params: ``params.features`` and the range limits of ``params.lidar``.
        scan: padded sweep.
    """
    image, xyz, time = _gathered(config, params, scan)
    with jax.named_scope("smoothness"):
        gap_squared = sum(((after_each(axis) - axis) ** 2 for axis in xyz), jnp.float32(0.0))
        connected = gap_squared <= params.features.connected_distance.astype(jnp.float32) ** 2
        smoothness = point_smoothness(xyz, config.features.neighbours)
        return _measured(config, image, xyz, time, smoothness, image.mask, connected)


def lio_sam_rings(config: ReadsRings, params: ReadsLioSamFeatures, scan: Scan) -> Rings:
    """Return the scan's rings with the smoothness of the ranges, without occluded and grazing points.

    Args:
        config: ``config.features``.
        params: ``params.features`` and the range limits of ``params.lidar``.
        scan: padded sweep.
    """
    image, xyz, time = _gathered(config, params, scan)
    limits, neighbours = params.features, config.features.neighbours
    with jax.named_scope("smoothness"):
        x, y, z = xyz
        ranges, column, mask = computed_once(jnp.sqrt(x**2 + y**2 + z**2)), image.column, image.mask
        hidden = occluded(
            ranges,
            column,
            mask,
            step=limits.occlusion_step.astype(jnp.float32),
            columns_apart=limits.occlusion_columns.astype(jnp.float32),
            neighbours=neighbours,
        )
        grazed = parallel_to_beam(ranges, limits.parallel_ratio.astype(jnp.float32))
        apart = jnp.abs(after_each(column) - column).astype(jnp.float32)
        connected = apart <= limits.connected_columns.astype(jnp.float32)
        smoothness = range_smoothness(ranges, neighbours)
        return _measured(config, image, xyz, time, smoothness, mask & ~hidden & ~grazed, connected)


def _gathered(
    config: ReadsRings, params: ReadsFeatures, scan: Scan
) -> tuple[RangeImage, tuple[Array, Array, Array], Array]:
    """Return the range image, the coordinates x, y and z along its rings (m), and the times (s)."""
    with jax.named_scope("range_image"):
        image = range_image(config.features, params.lidar, scan)
        x, y, z, time = (
            jnp.where(image.mask, values.at[image.index].get(mode="clip"), 0.0)
            for values in (*(scan.points[:, axis] for axis in range(3)), scan.time)
        )
        x, y, z, time = computed_once((x, y, z, time))
    return image, (x, y, z), time


def _measured(
    config: ReadsRings,
    image: RangeImage,
    xyz: tuple[Array, Array, Array],
    time: Float32[Array, "k rings"],
    smoothness: Float32[Array, "k rings"],
    open_: Bool[Array, "k rings"],
    connected: Bool[Array, "k rings"],
) -> Rings:
    settings = config.features
    before, after = reach(connected, settings.neighbours)
    ring = Ring(smoothness, open_, before, after, settings.neighbours)
    return Rings(image, xyz, time, ring, sector_bounds(image.count, settings.sectors, settings.neighbours))


def _picked(config: ReadsRings, params: ReadsFeatures, rings: Rings, flats: int | None) -> Picks:
    with jax.named_scope("pick"):
        return pick(
            rings.ring,
            rings.bounds,
            corner_threshold=params.features.corner_threshold.astype(jnp.float32),
            flat_threshold=params.features.flat_threshold.astype(jnp.float32),
            corners=config.features.corners,
            flats=flats,
        )


def _cloud(scan: Scan, rings: Rings, places: Int32[Array, "c sectors rings"]) -> FeatureCloud:
    """Return the points at the given places along the rings; a place of -1 is masked."""
    number = jnp.broadcast_to(jnp.arange(places.shape[-1], dtype=jnp.int32), places.shape)
    mask = (places >= 0).ravel()
    index = rings.image.index[jnp.maximum(places, 0), number].ravel()
    return FeatureCloud(
        points=jnp.where(mask[:, None], scan.points[index], 0.0),
        time=jnp.where(mask, scan.time[index], 0.0),
        ring=jnp.where(mask, number.ravel(), 0),
        mask=mask,
    )


def _surface(
    config: ReadsRings, params: ReadsFeatures, rings: Rings, picks: Picks
) -> tuple[FeatureCloud, Int32[Array, ""]]:
    """Return the mean per ring and voxel of the sectors' points that are no corners, and the dropped rows."""
    k, count = rings.time.shape
    with jax.named_scope("surface"):
        number = jnp.arange(count, dtype=jnp.int32)
        cell = jnp.where(picks.corners >= 0, picks.corners * count + number, k * count)
        corner = jnp.zeros(k * count, bool).at[cell.ravel()].set(True, mode="drop").reshape(k, count)
        place = jnp.arange(k, dtype=jnp.int32)[:, None]
        surface = (place >= rings.bounds[0]) & (place < rings.bounds[-1]) & ~corner
        spacing = params.features.surface_spacing.astype(jnp.float32)
        means = mean_per_ring_and_voxel(
            rings.xyz, rings.time, surface, spacing, config.features.surface_points
        )
    return FeatureCloud(means.points, means.time, means.ring, means.mask), means.dropped


_Features = TypeVar("_Features")
_Rings = TypeVar("_Rings", bound=ReadsRings)
_Params = TypeVar("_Params", bound=ReadsFeatures)


def in_single_precision(
    pick: Callable[[_Rings, _Params, Scan], _Features], config: _Rings, params: _Params, scan: Scan
) -> _Features:
    """Pick features in single precision, and return them in the scan's dtype: the choice has no derivative.

    Args:
        pick: one of :func:`loam_features` and :func:`lio_sam_features`.
        config: ``config.features``.
        params: ``params.features`` and the range limits of ``params.lidar``.
        scan: padded sweep.
    """
    dtype = scan.points.dtype
    single = dataclasses.replace(
        scan, points=scan.points.astype(jnp.float32), time=scan.time.astype(jnp.float32)
    )
    found = pick(config, params, single)
    return jax.tree.map(_cast_to(dtype), found)


def corrected_clouds(lidar: LidarParams, features: _Features) -> _Features:
    """Return features whose points are corrected.

    The points of a mean are of one ring and near each other, so that the mean is corrected like its points.

    Args:
        lidar: the corrections.
        features: :class:`LoamFeatures` or :class:`LioSamFeatures`.
    """

    def corrected(node: Any) -> Any:
        if not isinstance(node, FeatureCloud):
            return node
        return dataclasses.replace(node, points=lidar.corrected(node.points, node.ring))

    return jax.tree.map(corrected, features, is_leaf=lambda node: isinstance(node, FeatureCloud))


def thinned_features(
    corner: FeatureCloud,
    surface: FeatureCloud,
    voxel_sizes: tuple[Float[Array, ""], Float[Array, ""]],
    corners: int,
    surfaces: int,
) -> tuple[FeatureCloud, FeatureCloud, Int32[Array, ""]]:
    """Return the means of corners and of surface points per voxel of the map, and how many were dropped.

    The points are averaged before motion compensation, so that the groups do not depend on the motion.
    Compensation moves the points of one voxel almost equally.

    Args:
        corner: corners of a scan.
        surface: surface points of a scan.
        voxel_sizes: of the map of corners and of the map of surface points, m.
        corners: capacity for corners.
        surfaces: capacity for surface points.
    """
    corner_size, surface_size = voxel_sizes
    kinds = ((corner, corner_size, corners), (surface, surface_size, surfaces))
    clouds, dropped = [], jnp.int32(0)
    for cloud, size, capacity in kinds:
        mean = mean_per_voxel(cloud.points, cloud.mask, size.astype(jnp.float32), capacity, cloud.time)
        assert mean.time is not None
        clouds.append(FeatureCloud(mean.points, mean.time, jnp.zeros(capacity, jnp.int32), mean.mask))
        dropped += mean.dropped
    return clouds[0], clouds[1], dropped


def _cast_to(dtype: jnp.dtype) -> Callable[[Any], Any]:
    return lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf
