"""LOAM: odometry from scan to scan, mapping from scan to map, no inertial data (A-LOAM).

scan -> features -> scan to scan -> deskew -> scan to map -> insert -> cubes
                         |   every n-th scan --/    |
                     T_odom_lidar  ------------> T_map_odom -> T_world_lidar at every scan

Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014. Its values are those of
``recipe_settings("loam")``. Inertial samples are not used.

What differs from A-LOAM's program on purpose:

- Matches are searched up to 15 times for a scan, each time with up to 4 steps, and no further once the pose
  rests; there always 2 times (``config.loam.rounds``). A search keeps the matches while the points have moved
  by less than ``params.registration.reassociation_distance``.
- The motion within a sweep is compensated, as the pose under trial implies it; there it is switched off
  (``config.loam.compensate``). Poses are found at the sweep's middle and carried on to its end.
- A direction with less than ``params.registration.degeneracy_ratio`` of the strongest direction's information
  keeps the prediction; A-LOAM has no such rule.
- A voxel of the map holds the point nearest to its centre. A-LOAM's cubes hold the mean of a voxel's last
  mean and of the new points. A scan's own features are averaged per voxel, as there.
- Every scan is matched with the map (``config.loam.mapping_every``); there as many as the time allows.
- A scan with too few matches is lost, and after a long outage a new piece of map begins.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.leaf import section, static
from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, LOST, ImuBatch, NavState, Scan, initial_nav_state
from lio_jax.lidar.deskew import TrialMotion, twist_without_turn
from lio_jax.lidar.features import (
    FeatureCloud,
    LoamFeatures,
    check_sizes,
    corrected_clouds,
    in_single_precision,
    loam_features,
    thinned_features,
)
from lio_jax.lidar.params import LidarParams, LoamFeatureParams, LoamRingConfig
from lio_jax.mapping.feature_map import (
    FeatureMap,
    FeaturePoints,
    added_to_cubes,
    empty_feature_map,
    frames_at,
    placed_in,
)
from lio_jax.mapping.params import CubeGridParams, FeatureMapParams, MapConfig, PointMapParams
from lio_jax.recipes import recipe
from lio_jax.recipes.lidar_covariance import LidarCovariance, ScanOnMap, mean_squared_range
from lio_jax.recipes.params import RecipeConfig, RecipeParams
from lio_jax.recipes.recipe import Needs, Outage, Output, Recipe
from lio_jax.registration.feature_match import ScanToCubes
from lio_jax.registration.gauss_newton import Registration, gauss_newton, gauss_newton_with_matches
from lio_jax.registration.knn_planes import PLANE_SHARE
from lio_jax.registration.params import (
    GaussNewtonMatch,
    KnnConfig,
    LineFitParams,
    RegistrationConfig,
    RobustMatch,
    ScanToScanParams,
)
from lio_jax.registration.scan_match import FixedPoints
from lio_jax.registration.scan_to_scan import LastScan, ScanToScan, empty_scan, last_scan


class LoamMatch(GaussNewtonMatch, RobustMatch):
    """A match of features by Gauss-Newton."""


class LoamParams(RecipeParams):
    """Traced parameters of A-LOAM, in SI units."""

    lidar: LidarParams = section(LidarParams, min_range=0.3)
    map: FeatureMapParams = section(FeatureMapParams, voxel_size=0.8, corner_voxel_size=0.4)
    registration: LoamMatch = section(
        LoamMatch,
        kernel=0.1,
        reassociation_distance=0.05,
        rotation_tolerance=1e-3,
        translation_tolerance=1e-3,
        degeneracy_ratio=1e-4,
    )
    scan_to_scan: ScanToScanParams = section(ScanToScanParams)
    knn: LineFitParams = section(LineFitParams, radius=1.0, plane_tolerance=0.2)
    features: LoamFeatureParams = section(LoamFeatureParams)
    point_map: PointMapParams = section(PointMapParams)
    cubes: CubeGridParams = section(CubeGridParams)


@dataclass(frozen=True)
class LoamSizes:
    """Rounds and capacities."""

    rounds: int = static(15, above=0)
    """Largest number of searches for the matches of a scan; A-LOAM has 2. After each search at most
    ``config.registration.max_iterations`` steps follow. The search ends earlier once the pose rests."""
    compensate: bool = static(True)
    """Compensate the motion within a scan, as the pose under trial implies it."""
    mapping_every: int = static(1, above=0)
    """One scan of so many is matched with the map and added to it."""
    corner_points: int = static(4096, above=0)
    """Capacity of the corners that are matched with the map, after thinning."""
    surface_points: int = static(8192, above=0)
    """Capacity of the surface points that are matched with the map, after thinning."""


@dataclass(frozen=True)
class LoamConfig(RecipeConfig):
    """Static settings of A-LOAM."""

    map: MapConfig = section(MapConfig, capacity=65536)
    registration: RegistrationConfig = section(RegistrationConfig, max_iterations=4)
    knn: KnnConfig = section(KnnConfig)
    features: LoamRingConfig = section(LoamRingConfig, rings=0, columns=0, surface_points=0)
    loam: LoamSizes = section(LoamSizes)


class Targets(eqx.Module):
    """What scans are matched with."""

    cubes: FeatureMap
    last: LastScan
    """In the lidar frame of the last scan's middle."""

    def varying(self) -> "Targets":
        """Return a tree of booleans: the points have a derivative."""
        return Targets(self.cubes.varying(), self.last.varying())


class LoamState(recipe.State):
    """What is carried from scan to scan."""

    nav: NavState
    """State at the last scan's end, corrected by the map."""
    T_odom_lidar: jaxlie.SE3
    """Pose of the scan to match the next one with, at its middle, where deskewing has the least error."""
    T_map_odom: jaxlie.SE3
    """Correction that the last match with the map found."""
    since: Float[Array, ""]
    """Time from that middle to the last scan's end, s."""
    twist: Float[Array, "6"]
    """Velocity of the lidar in its own frame, m/s then rad/s."""
    scans: Int32[Array, ""]
    """Number of scans with points so far."""
    unmatched: Float[Array, ""]
    """Time since the last scan that was matched, s."""
    uncertain: LidarCovariance
    map: Targets

    def varying_map(self) -> Targets:
        """Return which leaves of the map have a derivative: the points of the cubes and of the last scan."""
        return self.map.varying()

    def with_velocity_of(self, found: "LoamState") -> "LoamState":
        """Return this first state with the velocity of a later one."""
        return eqx.tree_at(lambda state: state.twist, self, found.twist)


class Loam(Recipe[LoamConfig, LoamParams, LoamState]):
    """LOAM as A-LOAM implements it."""

    needs = Needs(imu="unused", rings=True)
    config_type = LoamConfig
    params_type = LoamParams
    # voxels for rooms: where walls are near, those for streets hold more than one
    near_values: ClassVar[Mapping[str, float]] = {
        "params.map.voxel_size": 0.2,
        "params.map.corner_voxel_size": 0.1,
    }

    @property
    def compensates(self) -> bool:
        return self.config.loam.compensate

    def init(self, params: LoamParams, imu: ImuBatch | None = None) -> LoamState:
        """Return the state before the first scan: at the world's origin, with an empty map.

        Args:
            params: traced.
            imu: not used.
        """
        config = self.config
        features = config.features
        check_sizes(config)
        nav = initial_nav_state(params.extrinsics.T_imu_lidar())
        nav = dataclasses.replace(nav, velocity=params.initial.velocity)
        dtype = nav.velocity.dtype
        start = nav.T_world_imu @ nav.T_imu_lidar
        corners = features.corners * features.sectors * features.rings
        return LoamState(
            nav=nav,
            T_odom_lidar=jaxlie.SE3(jnp.array([1, 0, 0, 0, 0, 0, 0], dtype)),
            T_map_odom=jaxlie.SE3(start.wxyz_xyz),
            since=jnp.zeros((), dtype),
            twist=twist_without_turn(nav.velocity, nav.T_imu_lidar),
            scans=jnp.int32(0),
            unmatched=jnp.zeros((), dtype),
            uncertain=LidarCovariance.at_start(dtype),
            map=Targets(
                empty_feature_map(config.map.capacity),
                empty_scan(corners, features.surface_points, features.rings),
            ),
        )

    def step(
        self, params: LoamParams, state: LoamState, scan: Scan, imu: ImuBatch | None = None
    ) -> tuple[LoamState, Output]:
        """Match one scan with the last one, then with the map, and add it to the map.

        Args:
            params: traced.
            state: donate it.
            scan: padded sweep; ``scan.interval`` is the time since the last scan's end.
            imu: not used.
        """
        config = self.config
        first = state.scans == 0
        with jax.named_scope("features"):
            features = in_single_precision(loam_features, config, params, scan)
            features = corrected_clouds(params.lidar, features)
            enough = (
                jnp.sum(features.sharp.mask) + jnp.sum(features.flat.mask) > params.registration.min_matches
            )
        with jax.named_scope("predict"):
            turning = Outage.turning(params, state.unmatched, scan)
            motion = TrialMotion.since(state.twist, turning, state.since, scan, first)
            middle = motion.middle
        with jax.named_scope("scan_to_scan"):
            picks = _Compensated(features.sharp, features.flat, motion, config.loam.compensate)
            match = ScanToScan(
                points_at=picks,
                T_predicted=motion.predicted(),
                registration=params.registration,
                lidar=params.lidar,
                last=state.map.last,
                limits=params.scan_to_scan,
            )
            odometry = gauss_newton(match, config.loam.rounds, config.registration.max_iterations)
            # after an outage the last scan shows another place
            bridged = motion.elapsed > params.limits.outage
            T_last_lidar = jnp.where(bridged, motion.predicted().wxyz_xyz, odometry.T_world_lidar.wxyz_xyz)
            odometry = dataclasses.replace(odometry, T_world_lidar=jaxlie.SE3(T_last_lidar))
            T_odom_lidar = state.T_odom_lidar @ odometry.T_world_lidar
            twist = motion.twist_to(odometry.T_world_lidar)
        with jax.named_scope("scan_to_map"):
            room = config.loam.corner_points, config.loam.surface_points
            voxel_sizes = params.map.corner_voxel_size, params.map.voxel_size
            corner, surface, thinned_away = thinned_features(
                features.less_sharp, features.less_flat, voxel_sizes, *room
            )
            thin = _Compensated(corner, surface, motion, config.loam.compensate)(odometry.T_world_lidar)
            guess = state.T_map_odom @ T_odom_lidar
            its_turn = state.scans % config.loam.mapping_every == 0
            outage = Outage.at(params, state.unmatched + scan.interval, thin.together()[1])
            mapping, counted = _mapped(
                config, params, outage, state.map.cubes, thin, guess, odometry, its_turn
            )
            lost = (mapping.status == LOST) & ~first
            new_piece = outage.begins_piece(lost, params.registration)
            T = mapping.T_world_lidar
        with jax.named_scope("insert"):
            last = _last(config, features, motion, odometry.T_world_lidar, state.map.last)
            frames = frames_at(jax.lax.stop_gradient(T.translation()), params.map)
            moving = placed_in(frames, thin, T)
            placed = jax.lax.stop_gradient(moving)
            cubes, *added = added_to_cubes(
                state.map.cubes,
                moving,
                its_turn & (~lost | new_piece),
                frames,
                params.map,
                params.point_map,
                params.cubes,
            )

        with jax.named_scope("covariance"):
            matched, mask = thin.together()
            on_map = ScanOnMap(
                match=mapping,
                degeneracy_ratio=params.registration.degeneracy_ratio,
                arm_squared=mean_squared_range(matched, mask, middle.dtype),
                plane_share=jnp.full_like(middle, PLANE_SHARE),
                added=sum(jnp.sum(one.added) for one in added) / jnp.maximum(jnp.sum(mask), 1),
                lost=lost,
                new_piece=new_piece,
            )
            T_last, T_imu_lidar = state.T_map_odom @ state.T_odom_lidar, params.extrinsics.T_imu_lidar()
            uncertain, covariance = state.uncertain.after(
                motion, T_last, twist, on_map, state.scans, T_imu_lidar
            )

        T_world_imu = T @ jaxlie.SE3.exp(middle * twist) @ params.extrinsics.T_imu_lidar().inverse()
        velocity = T_world_imu.rotation() @ (params.extrinsics.T_imu_lidar().adjoint() @ twist)[:3]
        nav = dataclasses.replace(state.nav, T_world_imu=jaxlie.SE3(T_world_imu.wxyz_xyz), velocity=velocity)
        # a scan too poor to be matched with leaves the last one in its place
        of_odometry = T_odom_lidar, middle, last, uncertain
        of_odometry = jax.tree.map(
            lambda new, old: jnp.where(enough, new, old),
            of_odometry,
            (state.T_odom_lidar, motion.to_end, state.map.last, state.uncertain),
        )
        new_state = LoamState(
            nav=nav,
            T_odom_lidar=of_odometry[0],
            T_map_odom=jaxlie.SE3((T @ T_odom_lidar.inverse()).wxyz_xyz),
            since=of_odometry[1],
            twist=twist,
            scans=state.scans + jnp.any(features.less_flat.mask).astype(jnp.int32),
            unmatched=outage.after((first & ~jnp.any(features.less_flat.mask)) | (lost & ~new_piece)).astype(
                state.unmatched.dtype
            ),
            uncertain=of_odometry[3],
            map=Targets(cubes, of_odometry[2]),
        )
        corner_offset = (frames.corner.origin - frames.surface.origin).astype(placed.corner.dtype)
        return new_state, Output(
            registration=mapping,
            lost=lost,
            nis=jnp.zeros_like(middle),
            nis_dof=jnp.int32(0),
            points=jnp.concatenate([placed.corner + corner_offset, placed.surface]),
            points_mask=jnp.concatenate([placed.corner_mask, placed.surface_mask]),
            added=jnp.concatenate([insertion.added for insertion in added]),
            origin=frames.surface.origin,
            thinned_away=thinned_away + features.dropped,
            map_dropped=added[0].dropped + added[1].dropped,
            covariance=covariance,
            new_piece=new_piece,
            matched=counted & ~lost if config.registration.mark_matched else None,
            corners=jnp.arange(len(placed.corner_mask) + len(placed.surface_mask)) < len(placed.corner_mask),
        )


class _Compensated(eqx.Module):
    """Corners and surface points, compensated by the motion that a trial pose implies."""

    corner: FeatureCloud
    surface: FeatureCloud
    motion: TrialMotion
    wanted: bool = eqx.field(static=True)

    def __call__(self, T_last_lidar: jaxlie.SE3) -> FeaturePoints:
        """Return the points in the lidar frame of the scan's middle."""
        corner, surface = (
            self.motion.compensated(cloud.points, cloud.time, T_last_lidar) if self.wanted else cloud.points
            for cloud in (self.corner, self.surface)
        )
        return FeaturePoints(corner, self.corner.mask, surface, self.surface.mask)


def _mapped(
    config: LoamConfig,
    params: LoamParams,
    outage: Outage,
    cubes: FeatureMap,
    points: FeaturePoints,
    guess: jaxlie.SE3,
    odometry: Registration,
    its_turn: Bool[Array, ""],
) -> tuple[Registration, Bool[Array, " k"]]:
    """Return the match with the map, or that with the last scan if it is not the map's turn.

    The second result says which points, corners first, were matched with the map.
    """

    def with_map() -> tuple[Registration, Array]:
        match = ScanToCubes(
            points_at=FixedPoints(points),
            T_predicted=guess,
            registration=outage.required(params.registration),
            lidar=params.lidar,
            map=cubes,
            map_params=params.map,
            knn=params.knn,
            neighbours=config.knn.neighbours,
            cubes=params.cubes,
        )
        bounds = config.loam.rounds, config.registration.max_iterations
        found, matches = gauss_newton_with_matches(match, *bounds)
        # nobody asks: nothing is computed
        matched = match.counted(found.T_world_lidar, matches) if marked else nothing
        # the points' compensation rests on the odometry
        unfinished = (found.status == CONVERGED) & (odometry.status == ITERATION_LIMIT)
        status = jnp.where(unfinished, ITERATION_LIMIT, found.status)
        return dataclasses.replace(found, status=status), matched

    marked, nothing = config.registration.mark_matched, jnp.zeros_like(points.together()[1])
    if config.loam.mapping_every == 1:
        return with_map()
    return jax.lax.cond(
        its_turn,
        with_map,
        lambda: (dataclasses.replace(odometry, T_world_lidar=jaxlie.SE3(guess.wxyz_xyz)), nothing),
    )


def _last(
    config: LoamConfig,
    features: LoamFeatures,
    motion: TrialMotion,
    T_last_lidar: jaxlie.SE3,
    last: LastScan,
) -> LastScan:
    """Return what the next scan is matched with."""
    clouds = features.less_sharp, features.less_flat
    points = _Compensated(*clouds, motion, config.loam.compensate)(T_last_lidar)
    dtype = last.index.x.dtype
    corner, surface = points.corner.astype(dtype), points.surface.astype(dtype)
    return last_scan(*clouds, corner, surface, config.features.rings)
