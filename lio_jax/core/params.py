"""Traced parameters: every number that may be tuned, as a pytree of scalars.

Changing a leaf recompiles nothing, leaves batch under vmap. What shapes arrays lives in
:mod:`lio_jax.core.config`.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.backend_params import BackendParams, GpsParams, LoopParams
from lio_jax.core.param_values import DEFAULTS
from lio_jax.core.types import Scalar, state_dtype


class ImuParams(eqx.Module):
    """The inertial sensor's noise, as continuous-time densities."""

    gyro_noise: Scalar
    """White noise of the angular rate, rad/s/sqrt(Hz)."""
    accel_noise: Scalar
    """White noise of the specific force, m/s^2/sqrt(Hz)."""
    gyro_bias_walk: Scalar
    """Random walk of the gyroscope's bias, rad/s^2/sqrt(Hz)."""
    accel_bias_walk: Scalar
    """Random walk of the accelerometer's bias, m/s^3/sqrt(Hz)."""
    gravity: Scalar
    """Magnitude of gravity, m/s^2."""


class InitialParams(eqx.Module):
    """Standard deviations of the first navigation state; zero freezes that part of the state."""

    rotation_sigma: Scalar
    """Of roll and pitch, rad. Zero, because the first scan's map is as tilted as the first pose: what is
    unknown is where gravity points in that world."""
    velocity_sigma: Scalar
    """m/s. Wide, because inertial samples can't tell rest from constant velocity; the second scan can."""
    gyro_bias_sigma: Scalar
    """rad/s."""
    accel_bias_sigma: Scalar
    """m/s^2."""
    gravity_sigma: Scalar
    """Of gravity's direction in the world that the first pose defines, before the samples at rest, rad."""
    extrinsic_rotation_sigma: Scalar
    """Of T_imu_lidar's rotation, rad."""
    extrinsic_translation_sigma: Scalar
    """Of T_imu_lidar's translation, m."""
    time_offset_sigma: Scalar
    """s."""


class LidarParams(eqx.Module):
    """The sensor's measurement model."""

    range_sigma: Scalar
    """Standard deviation of a range, m; of a point from its surface in all, unless the next is above zero."""
    surface_sigma: Scalar
    """Of surfaces from the planes of the default recipe's map, beyond the scatter of their points, m."""
    angle_sigma: Scalar
    """Standard deviation of a beam's direction, rad: it counts at long range and grazing incidence."""
    min_range: Scalar
    """Nearer points are dropped, m."""
    max_range: Scalar
    """Farther points are dropped, m."""


class MapParams(eqx.Module):
    """The voxel map."""

    voxel_size: Scalar
    """Edge length of a voxel, m."""
    corner_voxel_size: Scalar
    """Likewise in the map of corners, where there is one, m."""
    point_spacing: Scalar
    """The scan is thinned to one point per cube of this edge before it enters the map, m."""
    min_points: Scalar
    """Points a voxel needs before scans are matched against it."""
    reach: Scalar
    """Voxels farther than this from the sensor may be forgotten, m."""


class RegistrationParams(eqx.Module):
    """The scan-to-map solve."""

    point_spacing: Scalar
    """The scan is thinned to one point per cube of this edge before it is matched, m."""
    inertial_point_spacing: Scalar
    """The same in a filter on the voxels' planes, whose prediction needs fewer points to correct it, m."""
    kernel: Scalar
    """Scale of the robust kernel, m: Geman-McClure's; in loam Huber's."""
    information_scale: Scalar
    """Share of the matches' information that the filter believes: neighbours share the map's error."""
    reassociation_distance: Scalar
    """Points are matched anew once the scan has moved farther than this from where it was matched, m."""
    rotation_tolerance: Scalar
    """The solve has converged when a step turns less than this, rad ..."""
    translation_tolerance: Scalar
    """... and moves less than this, m."""
    degeneracy_ratio: Scalar
    """A direction with less than this fraction of the strongest direction's information is degenerate."""
    inertial_degeneracy_ratio: Scalar
    """The same in a filter, whose prediction has a covariance: it weighs what little is known, such as a few
    trees on a plain, against what a map's roughness feigns."""
    min_matches: Scalar
    """Matched points below which a scan counts as lost."""


class ScanToScanParams(eqx.Module):
    """Matches of a scan with the one before it."""

    radius: Scalar
    """Matched points have to be nearer than this, m."""
    rings_apart: Scalar
    """Of a match's points the others are fewer rings than this away from the nearest one's; at most 3."""


class KnnParams(eqx.Module):
    """Planes and lines through a point's nearest neighbours in the map."""

    radius: Scalar
    """The farthest neighbour has to be nearer than this, m."""
    plane_tolerance: Scalar
    """All neighbours have to be within this distance of their plane, m."""
    line_ratio: Scalar
    """Neighbours make a line if their largest variance exceeds this many times the second."""
    distance_weight: Scalar
    """w of a match's score 1 - w |d| / sqrt(r): d its distance from the plane, r its range, m."""
    min_score: Scalar
    """A match counts if its score is larger than this."""


class FeatureParams(eqx.Module):
    """What counts as a corner, as flat, and as too doubtful for either."""

    corner_threshold: Scalar
    """Corners have a smoothness above this, m^2 (LIO-SAM's, of ranges: 1.0)."""
    flat_threshold: Scalar
    """Flat points have a smoothness below this, m^2."""
    connected_distance: Scalar
    """A pick suppresses its neighbours as far as points that follow each other are no farther apart, m ..."""
    connected_columns: Scalar
    """... or, in LIO-SAM, no more columns than this."""
    occlusion_step: Scalar
    """Points behind an edge with a larger difference in range than this are no features, m ..."""
    occlusion_columns: Scalar
    """... if the edge's two points are fewer columns than this apart."""
    parallel_ratio: Scalar
    """No feature is a point whose range differs from both neighbours' by more than this share of it."""
    surface_spacing: Scalar
    """Surface points are averaged per ring and cube of this edge, m (LIO-SAM: 0.4)."""


class PointMapParams(eqx.Module):
    """A map of one point per voxel, inside a cube that follows the sensor."""

    cube_side_length: Scalar
    """Outside of the cube nothing is kept, m."""
    cube_margin: Scalar
    """The cube moves when the sensor is nearer to a face than this many times ``lidar.max_range``."""
    nearer_by: Scalar
    """A point takes its voxel over if it is nearer to the centre than the one there by more than this, m.
    Within the range noise that of the luckiest noise would stay: surfaces would lean to the centres."""


class CubeGridParams(eqx.Module):
    """The grid of cubes that LOAM keeps its map in; numbers are of cubes."""

    edge: Scalar
    """Of a cube, m."""
    across: Scalar
    """Cubes along x, and along y."""
    up: Scalar
    """Cubes along z."""
    margin: Scalar
    """The grid moves, by whole cubes, when fewer than this many are left before the sensor."""
    matched_across: Scalar
    """Along x, and along y: of so many around the sensor the points are matched."""
    matched_up: Scalar
    """Along z."""


class SubmapParams(eqx.Module):
    """Keyframes, and those of them around the vehicle that scans are matched with."""

    keyframe_distance: Scalar
    """A scan this far from the last keyframe becomes one, m ..."""
    keyframe_angle: Scalar
    """... or one turned by this much, rad."""
    radius: Scalar
    """Keyframes within this distance are to be in the map, m; those that come back to it enter anew ..."""
    spacing: Scalar
    """... but one per so many metres only; the others' places are taken ..."""
    recent: Scalar
    """... once they are older than this, s."""
    min_corners: Scalar
    """A scan with fewer corners is not matched, nor one ..."""
    min_surfaces: Scalar
    """... with fewer surface points."""


class SmootherParams(eqx.Module):
    """What a scan match says to the smoother, and the smoother to the next scan match."""

    rotation_sigma: Scalar
    """Of a scan match's rotation, rad, where the sigmas are fixed."""
    translation_sigma: Scalar
    """Of its position, m."""
    degenerate_sigma: Scalar
    """Of both, rad and m, where it was degenerate."""
    kernel: Scalar
    """Scale of the robust kernel on scan matches, sigmas. Wide: a narrow one would take all matches for
    outliers once the velocity is wrong."""
    position_sigma: Scalar
    """Of the first position, m."""
    tolerance: Scalar
    """The smoother has converged when the next step would be shorter than this, sigmas."""
    tilt_weight: Scalar
    """Share by which the matched roll and pitch are drawn to the inertial ones."""
    tilt_limit: Scalar
    """Larger roll and pitch are cut off there, rad."""
    height_limit: Scalar
    """The same for z, m."""
    mapping_interval: Scalar
    """Least time between two scan matches, s; in between the inertial prediction stands."""


class MotionParams(eqx.Module):
    """The constant-velocity prediction between scans."""

    initial_error: Scalar
    """How far off the prediction may be before any velocity is known, m: it opens the robust kernel."""
    error_decay: Scalar
    """Share of the last expected prediction error kept when predictions turn out better, 0 to 1."""


class LimitParams(eqx.Module):
    """What is reported as a failure when it is exceeded."""

    speed: Scalar
    """m/s."""
    gyro_bias: Scalar
    """rad/s."""
    accel_bias: Scalar
    """m/s^2."""
    outage: Scalar
    """Time between two scans, s."""


class ExtrinsicsParams(eqx.Module):
    """T_imu_lidar."""

    rotation: Float[Array, "4"]
    """Quaternion xyzw."""
    translation: Float[Array, "3"]
    """Position of the lidar in the IMU frame, m."""
    time_offset: Scalar
    """Lag of the lidar's clock, s: a scan stamped t was taken at IMU time t + time_offset."""

    def T_imu_lidar(self) -> jaxlie.SE3:
        """Return the pose of the lidar in the IMU frame."""
        return jaxlie.SE3(
            jnp.concatenate([self.rotation[jnp.array([3, 0, 1, 2])], self.translation])
        ).normalize()


class Params(eqx.Module):
    """All traced parameters of a recipe."""

    imu: ImuParams
    initial: InitialParams
    lidar: LidarParams
    map: MapParams
    registration: RegistrationParams
    scan_to_scan: ScanToScanParams
    knn: KnnParams
    features: FeatureParams
    point_map: PointMapParams
    cubes: CubeGridParams
    submap: SubmapParams
    smoother: SmootherParams
    motion: MotionParams
    loop: LoopParams
    limits: LimitParams
    backend: BackendParams
    gps: GpsParams
    extrinsics: ExtrinsicsParams


_SECTIONS: dict[str, Any] = {f.name: f.type for f in dataclasses.fields(Params)}


def params_from_values(values: dict[str, dict[str, Any]]) -> Params:
    """Build the pytree from nested plain numbers, every leaf an array of the navigation state's dtype."""
    dtype = state_dtype()
    return Params(
        **{
            section: kind(**{key: jnp.asarray(value, dtype) for key, value in values[section].items()})
            for section, kind in _SECTIONS.items()
        }
    )


def default_params() -> Params:
    """Return the default recipe's parameters."""
    return params_from_values(DEFAULTS)


def values_from_params(params: Params) -> dict[str, dict[str, Any]]:
    """Return nested plain numbers, the inverse of :func:`params_from_values`."""
    return {
        section: {
            f.name: jax.device_get(getattr(getattr(params, section), f.name)).tolist()
            for f in dataclasses.fields(kind)
        }
        for section, kind in _SECTIONS.items()
    }
