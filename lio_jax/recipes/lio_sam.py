"""LIO-SAM: scan matching against keyframes, and a smoother that ties its poses to the inertial samples.

imu  -> preintegrate -> predict ----------------> smoother (window of states) -> velocity, biases
                           |                         |
scan -> features -> thin -> deskew -> scan to submap / -> keyframe? -> submap (lines and planes)

Shan, Englot, Meyers, Wang, Ratti & Rus, "LIO-SAM: Tightly-coupled lidar inertial odometry via smoothing and
mapping", IROS 2020, in its program's form; a sliding window takes ISAM2's place. Its values are those of
``recipe_settings("lio_sam")``.

What differs from LIO-SAM's program on purpose:

- The window weighs a match by its information, and the pose is the smoothed one. With
  ``config.lio_sam.lidar_noise=fixed`` the match has LIO-SAM's sigmas, and the pose is the matched one.
- A direction is degenerate if its information is below ``params.registration.degeneracy_ratio`` of the
  strongest direction's, at every step; there if an eigenvalue at the first iteration is below 100, which
  depends on the number of points.
- Lines and planes are searched anew once the points have moved by more than
  ``params.registration.reassociation_distance``; there at each iteration. Neighbours that lie on a line
  define no plane (``params.knn.least_width``).
- A voxel of the submap holds the point nearest to its centre. With ``config.lio_sam.map_points=mean`` it
  holds the mean of its points, as there; a parameter file of LIO-SAM sets that. Points stay in the submap
  until its cube leaves them; there the submap is made of the keyframes around again and again.
- A scan's corners and surface points are averaged per voxel, as there, but before their motion is
  compensated. They are compensated to the scan's end, with the translation; there to its start, rotation
  alone.
- Every scan is matched; there at most one in 0.15 s (``params.smoother.mapping_interval``).
- The match is turned towards the inertial tilt by the shortest turn; there roll and pitch one by one.
- The window estimates the direction of gravity. The first velocity has a sigma of 100 m/s; LIO-SAM's 1e4 is
  singular in double precision. Where they are not given, the densities come from the recording.
- Loops and fixes are the runner's back end, with tests of its own for a loop.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie

from lio_jax.core.error_state import NavEstimate
from lio_jax.core.errors import UsageError
from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, ImuBatch, NavState, Scan, state_dtype
from lio_jax.estimation.latest_error import LatestError
from lio_jax.estimation.sliding_window import log_evidence, moved_by, turn_of_tilt
from lio_jax.lidar.features import (
    check_sizes,
)
from lio_jax.mapping.feature_map import Submap, empty_feature_map, rebuilt
from lio_jax.mapping.keyframes import Keyframes, Page, no_keyframes, with_page
from lio_jax.recipes.inertial_filter import levelled_start, lidar_pose
from lio_jax.recipes.lio_sam_params import LioSamConfig, LioSamParams
from lio_jax.recipes.lio_sam_stages import (
    Addition,
    Clock,
    Features,
    LioSamState,
    MapMatch,
    Smoothing,
    as_nav,
    clock_at,
    compensated,
    in_the_map,
    keyframe,
    picked_features,
    predict,
    scan_to_map,
    smooth,
)
from lio_jax.recipes.recipe import KeyframeTable, Needs, Output, Recipe
from lio_jax.recipes.smoothed_odometry import measured_attitude, nav_covariance, opened, unknowns_covariance


class LioSam(Recipe[LioSamConfig, LioSamParams, LioSamState]):
    """LIO-SAM; its back end is the runner's, whose corrections :meth:`corrected` takes over."""

    needs = Needs(imu="required", rings=True)
    config_type = LioSamConfig
    params_type = LioSamParams
    inertial_noise_from_recording = True
    # LIO-SAM's values for indoors
    near_values: ClassVar[Mapping[str, float]] = {
        "params.map.voxel_size": 0.2,
        "params.map.corner_voxel_size": 0.1,
        "params.features.surface_spacing": 0.2,
    }
    # it carries the velocity on, but not the rate
    longest_bridged_gap = 5.0
    given_values: ClassVar[Mapping[str, Any]] = {
        "config.backend.gps_elevation": False,
        "params.gps.pose_variance": 25.0,
        "params.gps.max_variance": 2.0,
    }

    def init(self, params: LioSamParams, imu: ImuBatch | None = None) -> LioSamState:
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
        start = levelled_start(params, imu)
        nav = start.nav
        attitude, there = measured_attitude(imu, jnp.max(imu.time), nav.T_world_imu.rotation())
        if not config.imu.heading:
            level = attitude.as_rpy_radians()
            attitude = jaxlie.SO3.from_rpy_radians(level.roll, level.pitch, jnp.zeros_like(level.yaw))
        rotation = jaxlie.SO3(jnp.where(there, attitude.wxyz, nav.T_world_imu.rotation().wxyz))
        T_world_imu = jaxlie.SE3.from_rotation_and_translation(rotation, nav.T_world_imu.translation())
        nav = dataclasses.replace(nav, T_world_imu=T_world_imu)
        start = NavEstimate(nav, start.covariance)
        window = opened(config, params, start)
        zero = jnp.zeros((), nav.velocity.dtype)
        keyframes = no_keyframes(own.keyframes, own.corner_points, own.surface_points, zero.dtype)
        features = empty_feature_map(config.map.capacity, of_means=own.map_points == "mean")
        return LioSamState(
            nav=nav,
            window=window,
            time=zero,
            matched_at=zero - jnp.inf,
            scans=jnp.int32(0),
            error=LatestError.of(unknowns_covariance(start)),
            map=Submap(keyframes, features),
        )

    def step(
        self, params: LioSamParams, state: LioSamState, scan: Scan, imu: ImuBatch | None = None
    ) -> tuple[LioSamState, Output]:
        """Predict by the inertial samples, match one scan with the keyframes around, smooth the window.

        Args:
            params: traced.
            state: donate it.
            scan: padded sweep; ``scan.interval`` is the time since the last scan's end.
            imu: samples around that time.
        """
        config = self.config
        assert imu is not None
        clock = clock_at(state, scan)
        with jax.named_scope("features"):
            features = picked_features(config, params, scan, clock.first)
        with jax.named_scope("predict"):
            prediction = predict(state, clock, imu)
            points = compensated(features, prediction.path, state.nav.T_imu_lidar)
        with jax.named_scope("scan_to_map"):
            match = scan_to_map(config, params, state, clock, points, prediction, imu, features.enough)
        with jax.named_scope("smooth"):
            smoothing = smooth(config, params, state, clock, points, prediction, imu, match)
        nav = dataclasses.replace(as_nav(state.nav, smoothing.window), T_world_imu=smoothing.T_world_imu)
        with jax.named_scope("keyframe"):
            added = keyframe(params, state, clock, points, nav, features, match, smoothing.failed)
        with jax.named_scope("covariance"):
            error = in_the_map(config, params, state, nav, points, match, smoothing, added)
        new_state = LioSamState(
            nav=nav,
            window=smoothing.window,
            time=clock.time,
            matched_at=jnp.where(match.used | match.new_piece, clock.time, state.matched_at),
            scans=state.scans + features.seen.astype(jnp.int32),
            error=error,
            map=added.submap,
        )
        output = _output(nav, clock, features, match, smoothing, added)
        return new_state, dataclasses.replace(
            output,
            covariance=nav_covariance(error.state, smoothing.window),
            keyframes=_table(state.map.keyframes, added.submap.keyframes, clock),
        )

    def with_page(self, params: LioSamParams, state: LioSamState, page: Page) -> LioSamState:
        """Return the state with a keyframe that has lost its row and comes back.

        Args:
            params: traced.
            state: after a scan; donate it.
            page: the keyframe.
        """
        here = lidar_pose(state.nav)
        keyframes = with_page(state.map.keyframes, page, here, params.submap)
        return eqx.tree_at(lambda some: some.map.keyframes, state, keyframes)

    def corrected(
        self, params: LioSamParams, state: LioSamState, T_new_old: jaxlie.SE3, keyframes: jaxlie.SE3
    ) -> LioSamState:
        """Return the state with corrected keyframes, as LIO-SAM's ``correctPoses`` leaves them.

        The vehicle and the smoother's window move rigidly, and velocity and the tilt of gravity turn with
        them. The map around the vehicle is built anew. Covariances of states refer to right perturbations and
        stay, and so does that of the map's error.

        Args:
            params: traced.
            state: after a scan; donate it.
            T_new_old: moves the vehicle, m; its rotation is about the vertical.
            keyframes: new T_world_lidar of the submap's k rows, m; those of free rows have no effect.
        """
        nav = state.nav.at_pose(T_new_old @ state.nav.T_world_imu)
        submap = rebuilt(
            state.map, keyframes, lidar_pose(nav), state.time, params.map, params.point_map, params.submap
        )
        window = moved_by(state.window, T_new_old)
        error = state.error.turned(turn_of_tilt(state.window.chain.gravity, T_new_old))
        nav = dataclasses.replace(nav, gravity=window.gravity())
        return dataclasses.replace(state, nav=nav, window=window, error=error, map=submap)


def _table(before: Keyframes, after: Keyframes, clock: Clock) -> KeyframeTable:
    """Return which keyframes there are after a scan."""
    is_added = after.count > before.count
    return KeyframeTable(
        numbers=after.number,
        added=jnp.where(is_added, before.count, -1),
        sparse=is_added & after.sparse[after.last],
        time=clock.time,
    )


def _output(
    nav: NavState, clock: Clock, features: Features, match: MapMatch, smoothing: Smoothing, added: Addition
) -> Output:
    found, smoothed, placed, frames = match.registration, smoothing.smoothed, added.placed, added.frames
    unfinished = (smoothed.status != CONVERGED) & (found.status == CONVERGED) & ~clock.first
    offset = (frames.corner.origin - frames.surface.origin).astype(placed.corner.dtype)
    corners, surfaces = len(placed.corner), len(placed.surface)
    return Output(
        registration=dataclasses.replace(
            found,
            T_world_lidar=lidar_pose(nav),
            status=jnp.where(unfinished, ITERATION_LIMIT, found.status),
        ),
        lost=match.lost,
        nis=smoothing.innovation.nis,
        nis_dof=smoothing.innovation.dof,
        points=jnp.concatenate([placed.corner + offset, placed.surface]),
        points_mask=jnp.concatenate([placed.corner_mask, placed.surface_mask]),
        added=jnp.concatenate([added.corner.added[:corners], added.surface.added[:surfaces]]),
        origin=frames.surface.origin,
        thinned_away=features.dropped,
        map_dropped=added.corner.dropped + added.surface.dropped,
        too_few_features=~features.enough,
        new_piece=match.new_piece,
        log_evidence=log_evidence(smoothing.window.chain, smoothed),
        corners=jnp.arange(corners + surfaces) < corners,
        restarted=smoothing.failed,
        smoother_unfinished=unfinished,
        matched=match.matched,
    )
