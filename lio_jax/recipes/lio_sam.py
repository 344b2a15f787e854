"""LIO-SAM: scan matching against keyframes, and a smoother that ties its poses to the inertial samples.

imu  -> preintegrate -> predict ----------------> smoother (window of states) -> velocity, biases
                           |                         |
scan -> features -> thin -> deskew -> scan to submap / -> keyframe? -> submap (lines and planes)

Shan, Englot, Meyers, Wang, Ratti & Rus, "LIO-SAM: Tightly-coupled lidar inertial odometry via smoothing and
mapping", IROS 2020, in its program's form; a sliding window takes ISAM2's place. Its values are those of
``recipe_settings("lio_sam")``.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int32

from lio_jax.core.config import Config
from lio_jax.core.error_state import DOF as NAV_DOF
from lio_jax.core.errors import UsageError
from lio_jax.core.geometry import from_blocks
from lio_jax.core.params import Params
from lio_jax.core.status import CONVERGED, ITERATION_LIMIT, LOST
from lio_jax.core.types import ImuBatch, NavState, Scan, state_dtype
from lio_jax.estimation.chain import information_of, linearise
from lio_jax.estimation.marginal_likelihood import log_evidence
from lio_jax.estimation.motion_state import DOF
from lio_jax.estimation.sliding_window import Added, Window, append_and_update
from lio_jax.estimation.smoother import Smoothed
from lio_jax.imu.path import Path, deskew_along
from lio_jax.imu.preintegration import preintegrate_parallel
from lio_jax.imu.sampling import sample_intervals
from lio_jax.imu.strapdown import path_along
from lio_jax.lidar.features import (
    FeatureCloud,
    check_sizes,
    in_single_precision,
    lio_sam_features,
    thinned_features,
)
from lio_jax.mapping.keyframes import is_due, no_keyframes
from lio_jax.recipes import recipe
from lio_jax.recipes.inertial_filter import levelled_start, lidar_pose
from lio_jax.recipes.output import Output
from lio_jax.recipes.pose_limits import drawn_to_tilt, measured_attitude, within_limits
from lio_jax.recipes.recipe import Needs, Recipe
from lio_jax.recipes.smoothed_odometry import match_as_measurement, opened, runs_away
from lio_jax.registration.feature_icp import register_features
from lio_jax.registration.feature_map import empty_feature_map
from lio_jax.registration.lines_and_planes import FeaturePoints
from lio_jax.registration.submap import ScanToSubmap, Submap, with_scan


class State(recipe.State):
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
    map: Submap

    def with_velocity_of(self, found: "State") -> "State":
        """Return this first state with the velocity of a later one."""
        rows = self.window.states.velocity
        velocity = found.nav.velocity

        def places(state: Any) -> tuple[Any, ...]:
            window = state.window
            return state.nav.velocity, window.states.velocity, window.chain.prior.origin.velocity

        return eqx.tree_at(
            places, self, (velocity, jnp.broadcast_to(velocity[..., None, :], rows.shape), velocity)
        )


class LioSam(Recipe[Config, Params, State]):
    """LIO-SAM without its back end."""

    needs = Needs(imu="required", rings=True)

    def init(self, params: Params, imu: ImuBatch | None = None) -> State:
        """Return the state before the first scan: at the world's origin, levelled, with an empty map.

        Args:
            params: traced.
            imu: samples of about a second up to the first scan's end.

        Raises:
            UsageError: there are no inertial data, or states are in single precision.
        """
        config = self.config
        own = config.lio_sam
        if imu is None:
            raise UsageError(
                "the recipe lio_sam needs inertial samples, and there are none (or config.imu.use is false); "
                "take loam, or default."
            )
        if state_dtype() != jnp.float64:
            raise UsageError(
                "the recipe lio_sam needs double precision, its smoother's information is singular without: "
                "call jax.config.update('jax_enable_x64', True) before anything else."
            )
        check_sizes(config)
        nav = levelled_start(params, imu).nav
        attitude, there = measured_attitude(imu, jnp.max(imu.time), nav.T_world_imu.rotation())
        if not config.imu.heading:
            level = attitude.as_rpy_radians()
            attitude = jaxlie.SO3.from_rpy_radians(level.roll, level.pitch, jnp.zeros_like(level.yaw))
        rotation = jaxlie.SO3(jnp.where(there, attitude.wxyz, nav.T_world_imu.rotation().wxyz))
        T_world_imu = jaxlie.SE3.from_rotation_and_translation(rotation, nav.T_world_imu.translation())
        nav = dataclasses.replace(nav, T_world_imu=T_world_imu)
        zero = jnp.zeros((), nav.velocity.dtype)
        keyframes = no_keyframes(own.keyframes, own.corner_points, own.surface_points, zero.dtype)
        return State(
            nav=nav,
            window=opened(config, params, nav),
            time=zero,
            matched_at=zero - jnp.inf,
            scans=jnp.int32(0),
            map=Submap(keyframes, empty_feature_map(config.map.capacity)),
        )

    def step(
        self, params: Params, state: State, scan: Scan, imu: ImuBatch | None = None
    ) -> tuple[State, Output]:
        """Predict by the inertial samples, match one scan with the keyframes around, smooth the window.

        Args:
            params: traced.
            state: donate it.
            scan: padded sweep; ``scan.interval`` is the time since the last scan's end.
            imu: samples around that time.
        """
        config = self.config
        assert imu is not None
        first = state.scans == 0
        dtype = state.nav.velocity.dtype
        end = scan.duration.astype(dtype)
        interval = jnp.where(first, 0.0, scan.interval.astype(dtype))
        time = state.time + interval
        with jax.named_scope("features"):
            features = in_single_precision(lio_sam_features, config, params, scan)
            room = config.lio_sam.corner_points, config.lio_sam.surface_points
            corner, surface, thinned_away = thinned_features(features.corner, features.surface, params, *room)
            least = params.submap.min_corners, params.submap.min_surfaces
            enough = (jnp.sum(corner.mask) >= least[0]) & (jnp.sum(surface.mask) >= least[1])
            # a first scan that is too poor would be a map in which nothing is ever found
            seen = jnp.where(first, enough, jnp.any(features.surface.mask))
        with jax.named_scope("predict"):
            odometry = _as_nav(state.nav, state.window)
            # the first scan's end is the world's origin: its samples only deskew it
            path = path_along(odometry, imu, jnp.where(first, 0.0, end - interval), end)
            predicted = jaxlie.SE3(path.T_world_imu.wxyz_xyz[-1])
            moved = odometry.T_world_imu.inverse() @ predicted
            guess = jaxlie.SE3(
                jnp.where(first, state.nav.T_world_imu.wxyz_xyz, (state.nav.T_world_imu @ moved).wxyz_xyz)
            )
            points = _compensated(corner, surface, path, state.nav.T_imu_lidar)
        with jax.named_scope("scan_to_map"):
            task = ScanToSubmap(
                map=state.map.features,
                points=points,
                T_predicted=jaxlie.SE3((guess @ state.nav.T_imu_lidar).wxyz_xyz),
                params=params,
                neighbours=config.knn.neighbours,
            )
            match = register_features(task, config.registration.max_iterations, 1)
            due = time - state.matched_at >= params.smoother.mapping_interval - _TIME_SLACK
            lost = ((match.status == LOST) | ~enough) & ~first
            matched = due & ~lost & ~first
            T_matched = within_limits(match.T_world_lidar, params.smoother) @ state.nav.T_imu_lidar.inverse()
            attitude, _ = measured_attitude(imu, end + state.nav.time_offset, guess.rotation())
            T_matched = drawn_to_tilt(T_matched, attitude, params.smoother.tilt_weight)
            T_world_imu = jaxlie.SE3(jnp.where(matched, T_matched.wxyz_xyz, guess.wxyz_xyz))
        with jax.named_scope("smooth"):
            intervals = sample_intervals(imu, state.nav.time_offset, end - interval, end)
            latest = state.window.latest()
            link = preintegrate_parallel(intervals, latest.gyro_bias, latest.accel_bias, params.imu)
            measured = match_as_measurement(config, params, T_world_imu, match, _arm_squared(points), matched)
            window, smoothed = append_and_update(
                state.window,
                Added(link, measured),
                max_iterations=config.lio_sam.smoother_iterations,
                tolerance=params.smoother.tolerance,
            )
            failed = runs_away(window.latest(), params) & ~first
            # neither the samples that led astray nor a match that began at their prediction
            place = state.nav.T_world_imu.translation() + interval * odometry.velocity
            coasted = jaxlie.SE3.from_rotation_and_translation(guess.rotation(), place)
            T_world_imu = jaxlie.SE3(jnp.where(failed, coasted.wxyz_xyz, T_world_imu.wxyz_xyz))
            fresh = opened(config, params, _at_rest(state.nav, T_world_imu), params.smoother.degenerate_sigma)
            window = jax.tree.map(
                lambda old, new, anew: jnp.where(first, old, jnp.where(failed, anew, new)),
                state.window,
                window,
                fresh,
            )
            # of the window that is kept, whichever it is
            normal = jax.lax.cond(
                first | failed,
                lambda kept, _: linearise(kept.chain, information_of(kept.chain), kept.states),
                lambda _, normal: normal,
                window,
                smoothed.normal,
            )
            smoothed = dataclasses.replace(smoothed, states=window.states, normal=normal)
        nav = dataclasses.replace(_as_nav(state.nav, window), T_world_imu=T_world_imu)
        with jax.named_scope("keyframe"):
            # the map is a constant of the derivative
            T_world_lidar, still = jax.lax.stop_gradient((lidar_pose(nav), points))
            away = time - jnp.maximum(state.matched_at, 0.0) > params.limits.outage
            # where the map does not reach, a new piece of it begins at the prediction
            sound = ((matched | (lost & enough & away)) & ~failed) | (first & seen)
            keyframe = sound & is_due(state.map.keyframes, T_world_lidar, params.submap)
            submap, frames, placed, added = with_scan(
                state.map, keyframe, still, T_world_lidar, jax.lax.stop_gradient(time), params
            )
        new_state = State(
            nav=nav,
            window=window,
            time=time,
            matched_at=jnp.where(matched, time, state.matched_at),
            scans=state.scans + seen.astype(jnp.int32),
            map=submap,
        )
        corners, surfaces = len(placed.corner), len(placed.surface)
        unfinished = (match.status == CONVERGED) & (smoothed.status != CONVERGED) & ~first
        offset = (frames.corner.origin - frames.surface.origin).astype(placed.corner.dtype)
        return new_state, Output(
            registration=dataclasses.replace(
                match,
                T_world_lidar=lidar_pose(nav),
                status=jnp.where(unfinished, ITERATION_LIMIT, match.status),
            ),
            lost=lost,
            nis=jnp.zeros_like(end),
            nis_dof=jnp.int32(0),
            points=jnp.concatenate([placed.corner + offset, placed.surface]),
            points_mask=jnp.concatenate([placed.corner_mask, placed.surface_mask]),
            added=jnp.concatenate([added[0].added[:corners], added[1].added[:surfaces]]),
            origin=frames.surface.origin,
            thinned_away=thinned_away + features.dropped,
            map_dropped=added[0].dropped + added[1].dropped,
            covariance=_covariance(smoothed, window),
            log_evidence=log_evidence(window.chain, smoothed),
            corners=jnp.arange(corners + surfaces) < corners,
            restarted=failed,
        )


_TIME_SLACK = 1e-3
"""Sweeps do not end to the last bit in time, s."""


def _as_nav(nav: NavState, window: Window) -> NavState:
    """Return the navigation state with the latest of the window's."""
    latest = window.latest()
    return dataclasses.replace(
        nav,
        T_world_imu=jaxlie.SE3(latest.T_world_imu.wxyz_xyz),
        velocity=latest.velocity,
        gyro_bias=latest.gyro_bias,
        accel_bias=latest.accel_bias,
    )


def _at_rest(nav: NavState, T_world_imu: jaxlie.SE3) -> NavState:
    """Return what the smoother begins with after a failure: any velocity is as likely."""
    zero = jnp.zeros_like(nav.velocity)
    return dataclasses.replace(nav, T_world_imu=T_world_imu, velocity=zero, gyro_bias=zero, accel_bias=zero)


def _compensated(
    corner: FeatureCloud, surface: FeatureCloud, path: Path, T_imu_lidar: jaxlie.SE3
) -> FeaturePoints:
    """Return features as the sensor would have seen them from where it was at the scan's end."""
    return FeaturePoints(
        corner=deskew_along(path, T_imu_lidar, corner.points, corner.time),
        corner_mask=corner.mask,
        surface=deskew_along(path, T_imu_lidar, surface.points, surface.time),
        surface_mask=surface.mask,
    )


def _arm_squared(points: FeaturePoints) -> Float[Array, ""]:
    """Return the mean squared distance of a scan's features from the sensor, m^2."""
    both = jnp.concatenate([points.corner, points.surface])
    mask = jnp.concatenate([points.corner_mask, points.surface_mask])
    total = jnp.sum(jnp.where(mask[:, None], both, 0.0) ** 2)
    return (total / jnp.maximum(jnp.sum(mask), 1)).astype(state_dtype())


def _covariance(smoothed: Smoothed, window: Window) -> Float[Array, "24 24"]:
    """Return the marginal covariance of the latest state, at its place in the navigation state's error."""
    latest = smoothed.covariances()[window.chain.count - 1]
    motion = slice(0, DOF)
    return from_blocks((NAV_DOF, NAV_DOF), (motion, motion, latest))
