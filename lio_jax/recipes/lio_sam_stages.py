"""The stages of LIO-SAM's step: features, prediction, scan to map, smoother, keyframe.

Each is a function of the state after the last scan and of what the stages before it found; the recipe
:mod:`lio_jax.recipes.lio_sam` runs them in order.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.types import LOST, ImuBatch, NavState, Scan, state_dtype
from lio_jax.estimation.chain import information_of, linearise
from lio_jax.estimation.factors import PoseMeasurement
from lio_jax.estimation.innovation import Innovation
from lio_jax.estimation.latest_error import LatestError, unless
from lio_jax.estimation.map_drift import error_by_planes, taken_into_map
from lio_jax.estimation.pose_logarithm import log_and_jacobian
from lio_jax.estimation.sliding_window import Added, Window, append_and_update
from lio_jax.estimation.smoother import Smoothed
from lio_jax.imu.path import Path, deskew_along
from lio_jax.imu.preintegration import Preintegrated, preintegrate_parallel
from lio_jax.imu.sampling import sample_intervals
from lio_jax.imu.strapdown import path_along
from lio_jax.lidar.features import (
    FeatureCloud,
    corrected_clouds,
    in_single_precision,
    lio_sam_features,
    thinned_features,
)
from lio_jax.mapping.feature_map import FeaturePoints, Frames, Submap, with_scan
from lio_jax.mapping.keyframes import is_due
from lio_jax.mapping.point_map import PointInsertion
from lio_jax.recipes import recipe
from lio_jax.recipes.inertial_filter import lidar_pose
from lio_jax.recipes.lio_sam_params import LioSamConfig, LioSamParams
from lio_jax.recipes.recipe import Outage
from lio_jax.recipes.smoothed_odometry import (
    drawn_to_tilt,
    match_as_measurement,
    measured_attitude,
    opened_anew,
    runs_away,
    within_limits,
)
from lio_jax.registration.feature_match import ScanToSubmap
from lio_jax.registration.gauss_newton import Registration, gauss_newton_with_matches
from lio_jax.registration.scan_match import FixedPoints

_TIME_SLACK = 1e-3
"""Sweeps do not end to the last bit in time, s."""
_PLANE_SHARE = 5.0
"""Variance of the pose by the errors of the map's lines and planes, as a share of that by a match."""


class LioSamState(recipe.State):
    """What is carried from scan to scan."""

    nav: NavState
    """At the last scan's end: the matched pose, velocity and biases of the smoother."""
    window: Window
    """The smoother's states, the latest at the last scan's end."""
    time: Float[Array, ""]
    """Since the first scan's end, s."""
    matched_at: Float[Array, ""]
    """The same of the last scan that was matched."""
    scans: Int32[Array, ""]
    """Scans with points seen so far."""
    error: LatestError
    """Covariance of the latest state's error in the world, and of the map's error."""
    map: Submap

    def varying_map(self) -> Submap:
        """Return which leaves of the map have a derivative: the keyframes' poses and the points around."""
        return self.map.varying()

    def with_velocity_of(self, found: "LioSamState") -> "LioSamState":
        """Return this first state with the velocity of a later one."""
        rows = self.window.states.velocity
        velocity = found.nav.velocity

        def places(state: Any) -> tuple[Any, ...]:
            window = state.window
            return state.nav.velocity, window.states.velocity, window.chain.prior.origin.velocity

        return eqx.tree_at(
            places, self, (velocity, jnp.broadcast_to(velocity[..., None, :], rows.shape), velocity)
        )


class Clock(eqx.Module):
    """The times of a scan."""

    first: Bool[Array, ""]
    """No scan was seen before."""
    end: Float[Array, ""]
    """The scan's end, s from its start."""
    interval: Float[Array, ""]
    """From the last scan's end to this one's, s; 0 for the first."""
    time: Float[Array, ""]
    """The scan's end, s from the first scan's."""


def clock_at(state: LioSamState, scan: Scan) -> Clock:
    """Return the times of a scan after a state."""
    first, dtype = state.scans == 0, state.nav.velocity.dtype
    interval = jnp.where(first, 0.0, scan.interval.astype(dtype))
    return Clock(first, scan.duration.astype(dtype), interval, state.time + interval)


class Features(eqx.Module):
    """A scan's thinned features, each at its own firing time."""

    corner: FeatureCloud
    surface: FeatureCloud
    enough: Bool[Array, ""]
    """There are as many corners and surface points as ``params.submap`` asks for."""
    seen: Bool[Array, ""]
    """The scan counts as one: it has points, and the first one has enough."""
    dropped: Int32[Array, ""]
    """Occupied cells beyond the capacities."""


def picked_features(
    config: LioSamConfig, params: LioSamParams, scan: Scan, first: Bool[Array, ""]
) -> Features:
    """Return the corners and surface points of a scan, corrected, and thinned as the map is.

    Args:
        config: ``config.features`` and the capacities ``config.lio_sam``.
        params: ``params.features``, ``params.lidar``, the voxel sizes, and ``params.submap`` for the least
            numbers.
        scan: padded sweep.
        first: no scan was seen before.
    """
    features = in_single_precision(lio_sam_features, config, params, scan)
    features = corrected_clouds(params.lidar, features)
    room = config.lio_sam.corner_points, config.lio_sam.surface_points
    voxel_sizes = params.map.corner_voxel_size, params.map.voxel_size
    corner, surface, thinned_away = thinned_features(features.corner, features.surface, voxel_sizes, *room)
    least = params.submap.min_corners, params.submap.min_surfaces
    enough = (jnp.sum(corner.mask) >= least[0]) & (jnp.sum(surface.mask) >= least[1])
    # a first scan that is too poor would be a map in which nothing is ever found
    seen = jnp.where(first, enough, jnp.any(features.surface.mask))
    return Features(corner, surface, enough, seen, thinned_away + features.dropped)


class Prediction(eqx.Module):
    """The motion that the samples foretell."""

    T_world_imu: jaxlie.SE3
    """The pose at the scan's end, where the scan match begins."""
    velocity: Float[Array, "3"]
    """The smoother's at the last scan's end, in world, m/s."""
    path: Path
    """From the last scan's end on, in the smoother's world."""


def predict(state: LioSamState, clock: Clock, imu: ImuBatch) -> Prediction:
    """Move the last matched pose by the increment of the smoother's state along the samples.

    Args:
        state: after the scan before.
        clock: of the scan.
        imu: samples around the time since then.
    """
    odometry = as_nav(state.nav, state.window)
    # the first scan's end is the world's origin: its samples only deskew it
    path = path_along(odometry, imu, jnp.where(clock.first, 0.0, clock.end - clock.interval), clock.end)
    increment = odometry.T_world_imu.inverse() @ jaxlie.SE3(path.T_world_imu.wxyz_xyz[-1])
    moved = state.nav.T_world_imu @ increment
    guess = jnp.where(clock.first, state.nav.T_world_imu.wxyz_xyz, moved.wxyz_xyz)
    return Prediction(jaxlie.SE3(guess), odometry.velocity, path)


def compensated(features: Features, path: Path, T_imu_lidar: jaxlie.SE3) -> FeaturePoints:
    """Return features as the sensor would have seen them from where it was at the scan's end."""
    corner, surface = features.corner, features.surface
    return FeaturePoints(
        corner=deskew_along(path, T_imu_lidar, corner.points, corner.time),
        corner_mask=corner.mask,
        surface=deskew_along(path, T_imu_lidar, surface.points, surface.time),
        surface_mask=surface.mask,
    )


class MapMatch(eqx.Module):
    """What matching a scan with the keyframes around gave."""

    registration: Registration
    T_world_imu: jaxlie.SE3
    """The matched pose, its tilt drawn to the inertial one; the prediction where the match is not used."""
    used: Bool[Array, ""]
    lost: Bool[Array, ""]
    """The scan could not be matched although there was a map."""
    new_piece: Bool[Array, ""]
    """A new piece of map begins with the scan, at the predicted pose."""
    matched: Bool[Array, " k"] | None
    """Which features, corners first, were matched; None unless ``config.registration.mark_matched``."""


def scan_to_map(
    config: LioSamConfig,
    params: LioSamParams,
    state: LioSamState,
    clock: Clock,
    points: FeaturePoints,
    prediction: Prediction,
    imu: ImuBatch,
    enough: Bool[Array, ""],
) -> MapMatch:
    """Match the features with the map, at most once in ``params.smoother.mapping_interval``.

    Args:
        config: ``config.knn`` and ``config.registration``.
        params: traced.
        state: after the scan before.
        clock: of the scan.
        points: compensated features, m, lidar frame of the scan's end.
        prediction: where the match begins.
        imu: samples, for the attitude that a nine-axis sensor reports.
        enough: there are features enough to match.
    """
    guess, T_imu_lidar = prediction.T_world_imu, state.nav.T_imu_lidar
    outage = Outage.at(params, clock.time - jnp.maximum(state.matched_at, 0.0), points.together()[1])
    match = ScanToSubmap(
        points_at=FixedPoints(points),
        T_predicted=jaxlie.SE3((guess @ T_imu_lidar).wxyz_xyz),
        registration=outage.required(params.registration),
        lidar=params.lidar,
        map=state.map.features,
        map_params=params.map,
        knn=params.knn,
        neighbours=config.knn.neighbours,
    )
    found, matches = gauss_newton_with_matches(match, config.registration.max_iterations)
    due = clock.time - state.matched_at >= params.smoother.mapping_interval - _TIME_SLACK
    lost = ((found.status == LOST) | ~enough) & ~clock.first
    used = due & ~lost & ~clock.first
    T_matched = within_limits(found.T_world_lidar, params.smoother) @ T_imu_lidar.inverse()
    attitude, _ = measured_attitude(imu, clock.end + state.nav.time_offset, guess.rotation())
    T_matched = drawn_to_tilt(T_matched, attitude, params.smoother.tilt_weight)
    T_world_imu = jaxlie.SE3(jnp.where(used, T_matched.wxyz_xyz, guess.wxyz_xyz))
    new_piece = lost & enough & outage.is_long
    marked = config.registration.mark_matched
    matched = match.counted(found.T_world_lidar, matches) & ~lost if marked else None
    return MapMatch(found, T_world_imu, used, lost, new_piece, matched)


class Smoothing(eqx.Module):
    """What the smoother made of the scan match and the samples."""

    window: Window
    smoothed: Smoothed
    """The smoother's result, of the window that is kept."""
    T_world_imu: jaxlie.SE3
    """The smoothed pose, or the matched one with fixed sigmas; after a failure the last one, carried on at
    the last velocity."""
    error: LatestError
    """Covariance of the latest state's error, before the scan is added to the map."""
    innovation: Innovation
    """Of the scan match."""
    failed: Bool[Array, ""]
    """Velocity or biases ran away, and the window began anew."""


def smooth(
    config: LioSamConfig,
    params: LioSamParams,
    state: LioSamState,
    clock: Clock,
    points: FeaturePoints,
    prediction: Prediction,
    imu: ImuBatch,
    match: MapMatch,
) -> Smoothing:
    """Add the samples and the matched pose to the window, and begin anew where the result runs away.

    Args:
        config: ``config.lio_sam``.
        params: ``params.imu``, ``params.smoother``, ``params.limits`` and what the window begins with.
        state: after the scan before.
        clock: of the scan.
        points: compensated features: their distances scale the match's rotations.
        prediction: by the samples.
        imu: samples around the time since the last scan's end.
        match: the scan's.
    """
    link, measured = _measurements(config, params, state, clock, points, imu, match)
    window, smoothed = append_and_update(
        state.window,
        Added(link, measured),
        max_iterations=config.lio_sam.smoother_iterations,
        tolerance=params.smoother.tolerance,
    )
    failed = runs_away(window.latest(), params) & ~clock.first
    # neither the samples that led astray nor a match that began at their prediction
    place = state.nav.T_world_imu.translation() + clock.interval * prediction.velocity
    coasted = jaxlie.SE3.from_rotation_and_translation(prediction.T_world_imu.rotation(), place)
    smoothing = (config.lio_sam.lidar_noise == "information") & ~clock.first
    found = jnp.where(smoothing, window.latest().T_world_imu.wxyz_xyz, match.T_world_imu.wxyz_xyz)
    T_world_imu = jaxlie.SE3(jnp.where(failed, coasted.wxyz_xyz, found))
    fresh = opened_anew(config, params, _at_rest(state.nav, T_world_imu), state.window)
    window = jax.tree.map(
        lambda old, new, anew: jnp.where(clock.first, old, jnp.where(failed, anew, new)),
        state.window,
        window,
        fresh,
    )
    # of the window that is kept, whichever it is
    normal = jax.lax.cond(
        clock.first | failed,
        lambda kept, _: linearise(kept.chain, information_of(kept.chain), kept.states, kept.tilt),
        lambda _, normal: normal,
        window,
        smoothed.normal,
    )
    smoothed = dataclasses.replace(smoothed, states=window.states, tilt=window.tilt, normal=normal)
    error, innovation = _judged(state, link, measured, prediction, smoothed, window, clock.first, failed)
    return Smoothing(window, smoothed, T_world_imu, error, innovation, failed)


def _judged(
    state: LioSamState,
    link: Preintegrated,
    measured: PoseMeasurement,
    prediction: Prediction,
    smoothed: Smoothed,
    window: Window,
    first: Bool[Array, ""],
    failed: Bool[Array, ""],
) -> tuple[LatestError, Innovation]:
    """Return the covariance of the latest state's error after a scan match, and the match's innovation."""
    last = window.chain.count - 1
    ends = [jax.tree.map(lambda rows, row=row: rows[row], smoothed.states) for row in (last - 1, last)]
    stated = smoothed.joint_covariance(last)
    predicted = state.error.propagated(link, window.chain.gravity, window.tilt, *ends)
    idle = first | failed | ~measured.mask
    information = jnp.where(idle, 0.0, measured.information)
    missed, _ = log_and_jacobian(prediction.T_world_imu.inverse() @ measured.T_world_imu)
    # the map keeps its error where the window begins anew
    anew = dataclasses.replace(LatestError.of(stated), map=predicted.map)
    error = unless(failed, anew, predicted.matched(stated, information))
    return unless(first, state.error, error), predicted.innovation(missed, information)


def _measurements(
    config: LioSamConfig,
    params: LioSamParams,
    state: LioSamState,
    clock: Clock,
    points: FeaturePoints,
    imu: ImuBatch,
    match: MapMatch,
) -> tuple[Preintegrated, PoseMeasurement]:
    """Return the samples up to the scan's end and the matched pose; arguments as of :func:`smooth`."""
    intervals = sample_intervals(imu, state.nav.time_offset, clock.end - clock.interval, clock.end)
    latest = state.window.latest()
    link = preintegrate_parallel(intervals, latest.gyro_bias, latest.accel_bias, params.imu)
    measured = match_as_measurement(
        config, params, match.T_world_imu, match.registration, _arm_squared(points), match.used
    )
    return link, measured


def in_the_map(
    config: LioSamConfig,
    params: LioSamParams,
    state: LioSamState,
    nav: NavState,
    points: FeaturePoints,
    match: MapMatch,
    smoothing: Smoothing,
    added: "Addition",
) -> LatestError:
    """Return the covariance of the latest state's error after the scan was added to the map.

    Args:
        config: ``config.lio_sam.lidar_noise``.
        params: ``params.registration``.
        state: after the scan before.
        nav: at the scan's end.
        points: compensated features.
        match: the scan's.
        smoothing: of the match.
        added: what was added to the map.
    """
    dtype = nav.velocity.dtype
    new = sum(
        jnp.sum(one.added[: len(mask)])
        for one, mask in ((added.corner, points.corner_mask), (added.surface, points.surface_mask))
    )
    share = (new / jnp.maximum(jnp.sum(points.together()[1]), 1)).astype(dtype)
    share = jnp.where(match.new_piece, 1.0, share)
    axes = jax.scipy.linalg.block_diag(*[rotation_matrix(lidar_pose(nav).rotation())] * 2)
    information = params.registration.information_scale * match.registration.information
    information = jnp.where(match.used, axes @ information @ axes.T, 0.0)
    planes = error_by_planes(information, _arm_squared(points), nav, jnp.asarray(_PLANE_SHARE, dtype))
    return smoothing.error.added(*taken_into_map(share, planes, state.scans))


class Addition(eqx.Module):
    """The map after a scan, and what the scan added to it."""

    submap: Submap
    frames: Frames
    placed: FeaturePoints
    """The scan's features, each kind in its frame."""
    corner: PointInsertion
    """The scan's corners first, then those of a keyframe that the vehicle comes back to."""
    surface: PointInsertion
    """Likewise."""


def keyframe(
    params: LioSamParams,
    state: LioSamState,
    clock: Clock,
    points: FeaturePoints,
    nav: NavState,
    features: Features,
    match: MapMatch,
    failed: Bool[Array, ""],
) -> Addition:
    """Make the scan a keyframe where its pose is sound and far enough from the last keyframe's.

    Args:
        params: ``params.submap``, ``params.point_map`` and the voxel sizes.
        state: after the scan before; its map is donated.
        clock: of the scan.
        points: compensated features, m, lidar frame of the scan's end.
        nav: at the scan's end.
        features: whether the scan counts.
        match: the scan's.
        failed: the smoother ran away.
    """
    T_world_lidar = lidar_pose(nav)
    sound = (match.used | match.new_piece) & ~failed
    sound = sound | (clock.first & features.seen)
    submap, frames, placed, added = with_scan(
        state.map,
        sound & (is_due(state.map.keyframes, T_world_lidar, params.submap) | match.new_piece),
        points,
        T_world_lidar,
        jax.lax.stop_gradient(clock.time),
        params.map,
        params.point_map,
        params.submap,
    )
    return Addition(submap, frames, placed, *added)


def as_nav(nav: NavState, window: Window) -> NavState:
    """Return the navigation state with the latest of the window's."""
    latest = window.latest()
    return dataclasses.replace(
        nav,
        T_world_imu=jaxlie.SE3(latest.T_world_imu.wxyz_xyz),
        velocity=latest.velocity,
        gyro_bias=latest.gyro_bias,
        accel_bias=latest.accel_bias,
        gravity=window.gravity(),
    )


def _at_rest(nav: NavState, T_world_imu: jaxlie.SE3) -> NavState:
    """Return what the smoother begins with after a failure: any velocity is as likely."""
    zero = jnp.zeros_like(nav.velocity)
    return dataclasses.replace(nav, T_world_imu=T_world_imu, velocity=zero, gyro_bias=zero, accel_bias=zero)


def _arm_squared(points: FeaturePoints) -> Float[Array, ""]:
    """Return the mean squared distance of a scan's features from the sensor, m^2."""
    both, mask = points.together()
    total = jnp.sum(jnp.where(mask[:, None], both, 0.0) ** 2)
    return (total / jnp.maximum(jnp.sum(mask), 1)).astype(state_dtype())
