"""Match corners with lines and surface points with planes (LOAM, LIO-SAM): in a map, its cubes or keyframes.

Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014, sections V.C and VI.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.lidar.params import LidarParams
from lio_jax.mapping.feature_map import FeatureMap, FeaturePoints, Frames, frames_at, matched_cubes
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.params import CubeGridParams, FeatureMapParams
from lio_jax.registration.knn_planes import fitted_to, planes_near
from lio_jax.registration.lines_and_planes import (
    FittedTo,
    LinesAndPlanes,
    Weights,
    counted,
    huber,
    linearise,
    lines_near,
    no_lines_and_planes,
    scored,
)
from lio_jax.registration.params import LineFitParams, RobustMatch, ScoredLineFitParams
from lio_jax.registration.scan_match import NormalEquations, ScanMatch


class FeatureMatch(ScanMatch[FeaturePoints, LinesAndPlanes]):
    """A scan's corners and surface points against lines and planes."""

    lidar: LidarParams

    @abc.abstractmethod
    def frames(self) -> Frames:
        """Return the frames of the matches."""

    def weights(self) -> Weights:
        """Return the robust weights of distances: Huber's."""
        assert isinstance(self.registration, RobustMatch)
        return huber(self.registration.kernel)

    def together(self, points: FeaturePoints) -> tuple[Float[Array, "k 3"], Bool[Array, " k"]]:
        return points.together()

    @abc.abstractmethod
    def fitted_to(self, found: LinesAndPlanes) -> FittedTo:
        """Return the points that lines and planes were fitted to."""

    def linearise(
        self, T_world_lidar: jaxlie.SE3, found: LinesAndPlanes, iteration: Int32[Array, ""]
    ) -> NormalEquations:
        points, range_sigma = self.points_at(T_world_lidar), self.lidar.range_sigma
        settings = self.frames(), self.weights(), range_sigma, self.fitted_to(found)
        return linearise(found, points, T_world_lidar, *settings)

    def counted(self, T_world_lidar: jaxlie.SE3, found: LinesAndPlanes) -> Bool[Array, " k"]:
        points = self.points_at(T_world_lidar)
        return counted(found, points, T_world_lidar, self.frames(), self.weights())


class ScanToFeatures(FeatureMatch):
    """A scan against a map of corners and surface points."""

    map: FeatureMap
    map_params: FeatureMapParams
    knn: LineFitParams
    neighbours: int = eqx.field(static=True)

    def frames(self) -> Frames:
        return frames_at(self.T_predicted.translation(), self.map_params)

    def unmatched(self) -> LinesAndPlanes:
        points, dtype = self.points_at(self.T_predicted), self.map.surface.point.dtype
        return no_lines_and_planes(points, self.neighbours, self.neighbours, dtype)

    def fitted_to(self, found: LinesAndPlanes) -> FittedTo:
        frames, sizes = self.frames(), self.map_params
        return FittedTo(
            fitted_to(self.map.corner, found.lines.first, frames.corner.anchor, sizes.corner_voxel_size),
            fitted_to(self.map.surface, found.planes, frames.surface.anchor, sizes.voxel_size),
        )

    def least_width(self) -> Float[Array, ""] | float:
        """Return the least width of the points that a plane is fitted to, m."""
        return 0.0

    def searched(self, placed: Float[Array, "k 3"], frame: Frame) -> Bool[Array, " k"]:
        """Return which points, in m from the frame's origin, are matched at all."""
        return jnp.ones(len(placed), bool)

    def associate(self, points: FeaturePoints, T_world_lidar: jaxlie.SE3) -> LinesAndPlanes:
        """Find lines and planes through the nearest map points."""
        frames, sizes = self.frames(), self.map_params
        _, corner = frames.corner.place(points.corner, T_world_lidar)
        _, surface = frames.surface.place(points.surface, T_world_lidar)
        return LinesAndPlanes(
            lines_near(
                self.map.corner,
                corner,
                points.corner_mask & self.searched(corner, frames.corner),
                frames.corner.anchor,
                sizes.corner_voxel_size,
                self.knn,
                self.neighbours,
            ),
            planes_near(
                self.map.surface,
                surface,
                points.surface_mask & self.searched(surface, frames.surface),
                frames.surface.anchor,
                sizes.voxel_size,
                self.knn,
                self.neighbours,
                self.least_width(),
            ),
        )


class ScanToCubes(ScanToFeatures):
    """A scan against the points in the cubes around the sensor's own (LOAM)."""

    cubes: CubeGridParams

    def searched(self, placed: Float[Array, "k 3"], frame: Frame) -> Bool[Array, " k"]:
        return matched_cubes(placed, frame, self.T_predicted.translation(), self.cubes)


class ScanToSubmap(ScanToFeatures):
    """A scan against the points of keyframes, weighed by their scores (LIO-SAM)."""

    knn: ScoredLineFitParams

    def weights(self) -> Weights:
        return scored(self.knn)

    def least_width(self) -> Float[Array, ""]:
        return self.knn.least_width * self.map_params.voxel_size
