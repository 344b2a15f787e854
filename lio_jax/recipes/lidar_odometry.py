"""LiDAR odometry without inertial data: constant velocity, voxel distributions, robust Gauss-Newton.

scan -> thin -> predict -> register (deskewing under trial) -> deskew -> insert -> map
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int32

from lio_jax.core.types import LOST, NavState, Scan, initial_nav_state
from lio_jax.lidar.deskew import TrialMotion, deskew_constant_velocity, twist_without_turn
from lio_jax.lidar.thinning import ThinnedScan, rows_of, thinned
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.voxel_map import VoxelMap, anchor_of, empty_map, insert
from lio_jax.mapping.voxel_tangents import following
from lio_jax.recipes import recipe
from lio_jax.recipes.default_params import DefaultConfig, DefaultParams
from lio_jax.recipes.lidar_covariance import LidarCovariance, ScanOnMap, mean_squared_range
from lio_jax.recipes.recipe import Outage, Output
from lio_jax.registration.gauss_newton import gauss_newton_with_matches
from lio_jax.registration.point_evidence import plane_share
from lio_jax.registration.voxel_planes import ScanToVoxels


class LidarState(recipe.State):
    """What is carried from scan to scan."""

    nav: NavState
    """State at the last scan's end."""
    T_world_lidar: jaxlie.SE3
    """Pose at the middle of the last scan, which registration finds: deskewing has the least error there."""
    mid_to_end: Float[Array, ""]
    """Time from the scan's middle to its end, s."""
    twist: Float[Array, "6"]
    """Velocity of the lidar in its own frame, m/s then rad/s."""
    prediction_error: Float[Array, ""]
    """Expected error of the next prediction, m."""
    scans: Int32[Array, ""]
    """Number of scans with points so far."""
    unmatched: Float[Array, ""]
    """Time since the last scan that was matched, s."""
    uncertain: LidarCovariance
    map: VoxelMap

    def varying_map(self) -> VoxelMap:
        """Return which leaves of the map have a derivative: the moments."""
        return self.map.varying()

    def with_velocity_of(self, found: "LidarState") -> "LidarState":
        """Return this first state with the velocity of a later one."""
        return eqx.tree_at(lambda state: state.twist, self, found.twist)


def init(config: DefaultConfig, params: DefaultParams) -> LidarState:
    """Return the state before the first scan: at the world's origin, with an empty map.

    Args:
        config: static.
        params: traced.
    """
    nav = initial_nav_state(params.extrinsics.T_imu_lidar())
    nav = dataclasses.replace(nav, velocity=params.initial.velocity)
    dtype = nav.velocity.dtype
    return LidarState(
        nav=nav,
        T_world_lidar=nav.T_world_imu @ nav.T_imu_lidar,
        mid_to_end=jnp.zeros((), dtype),
        twist=twist_without_turn(nav.velocity, nav.T_imu_lidar),
        prediction_error=jnp.asarray(params.motion.initial_error, dtype),
        scans=jnp.int32(0),
        unmatched=jnp.zeros((), dtype),
        uncertain=LidarCovariance.at_start(dtype),
        map=empty_map(config.map.capacity),
    )


def placed(state: LidarState, T_world_imu: jaxlie.SE3) -> LidarState:
    """Return a state before the first scan at another pose, in the world of a known map.

    Args:
        state: of :func:`init`.
        T_world_imu: in the map's world, whose z axis points upwards.
    """
    nav, covariance = state.nav, recipe.placed_covariance(state.uncertain.covariance)
    return eqx.tree_at(
        lambda one: (one.nav, one.T_world_lidar, one.uncertain.covariance),
        state,
        (nav.at_pose(T_world_imu), T_world_imu @ nav.T_imu_lidar, covariance),
    )


def step(
    config: DefaultConfig, params: DefaultParams, state: LidarState, scan: Scan
) -> tuple[LidarState, Output]:
    """Register one scan and add it to the map.

    Velocity is taken as constant from the middle of the last scan to the middle of this one, and is solved
    for together with the pose: each trial pose deskews the scan with the velocity it implies.

    Args:
        config: static.
        params: traced.
        state: donate it.
        scan: padded sweep; ``scan.interval`` is the time since the last scan's end.
    """
    with jax.named_scope("thin"):
        spacing = params.registration.point_spacing
        sizes = config.lidar.insertion_points, config.lidar.registration_points
        thin = thinned(params.lidar, scan, params.map.point_spacing, spacing, *sizes)
    with jax.named_scope("predict"):
        first, T_last = state.scans == 0, state.T_world_lidar
        turning = Outage.turning(params, state.unmatched, scan)
        motion = TrialMotion.since(state.twist, turning, state.mid_to_end, scan, first)
        prediction = T_last @ motion.predicted()
        outage = Outage.at(params, state.unmatched + scan.interval, thin.matched.mask)

    with jax.named_scope("register"):
        index = thin.matched.index
        match = ScanToVoxels(
            points_at=_Deskewed(thin.points[index], thin.time[index], motion, T_last),
            T_predicted=prediction,
            registration=outage.required(params.registration),
            map=state.map,
            mask=thin.matched.mask,
            prediction_error=state.prediction_error,
            map_params=params.map,
            lidar=params.lidar,
            plane_points=params.registration.plane_points,
        )
        result, matches = gauss_newton_with_matches(match, config.registration.max_iterations)
        lost = (result.status == LOST) & ~first
        new_piece = outage.begins_piece(lost, params.registration)
        twist = jnp.where(lost, motion.last_twist, motion.twist_to(T_last.inverse() @ result.T_world_lidar))
        missed = jnp.linalg.norm((prediction.inverse() @ result.T_world_lidar).translation())
        error = jnp.maximum(params.motion.error_decay * state.prediction_error, missed)
        # it only opens the kernel, which is closed at the solution
        known = jnp.where(new_piece, params.motion.initial_error, state.prediction_error)
        error = jax.lax.stop_gradient(jnp.where(first | lost, known, error))
    with jax.named_scope("insert"):
        T = result.T_world_lidar
        anchor, corner = anchor_of(T.translation(), params.map.voxel_size)
        placing = _Placed(thin, 0.5 * scan.duration, twist, T, Frame(anchor, corner))
        anchored = jax.lax.stop_gradient(placing(jnp.arange(len(thin.points), dtype=jnp.int32)))
        inserted, size = thin.mask & (~lost | new_piece), params.map.voxel_size.astype(jnp.float32)
        vmap, added = insert(
            state.map, anchored, inserted, anchor, size, params.map.reach.astype(jnp.float32)
        )
        vmap = following(vmap, state.map, added.added, anchored, inserted, placing, anchor, size)

    with jax.named_scope("covariance"):
        # not compensated: their ranges and the angles under which they are seen hardly differ
        matched = thin.points[index]
        on_map = ScanOnMap(
            match=result,
            degeneracy_ratio=params.registration.degeneracy_ratio,
            arm_squared=mean_squared_range(matched, thin.matched.mask, error.dtype),
            plane_share=plane_share(len(state.map.voxel), matches, matched, T, match.frame(), params.lidar),
            added=jnp.sum(added.added) / jnp.maximum(jnp.sum(thin.mask), 1),
            lost=lost,
            new_piece=new_piece,
        )
        T_imu_lidar = params.extrinsics.T_imu_lidar()
        uncertain, covariance = state.uncertain.after(motion, T_last, twist, on_map, state.scans, T_imu_lidar)

    T_world_imu = T @ jaxlie.SE3.exp(motion.middle * twist) @ params.extrinsics.T_imu_lidar().inverse()
    nav = eqx.tree_at(
        lambda nav: (nav.T_world_imu, nav.velocity),
        state.nav,
        (jaxlie.SE3(T_world_imu.wxyz_xyz), _imu_velocity(T_world_imu, twist, params)),
    )
    seen = jnp.any(thin.mask)
    new_state = LidarState(
        nav=nav,
        T_world_lidar=T,
        mid_to_end=motion.middle,
        twist=twist,
        prediction_error=error,
        scans=state.scans + seen.astype(jnp.int32),
        unmatched=outage.after((first & ~seen) | (lost & ~new_piece)),
        uncertain=uncertain,
        map=vmap,
    )
    return new_state, Output(
        registration=result,
        lost=lost,
        nis=jnp.zeros_like(error),
        nis_dof=jnp.int32(0),
        points=anchored,
        points_mask=thin.mask,
        added=added.added,
        origin=corner,
        thinned_away=thin.dropped,
        map_dropped=added.dropped,
        covariance=covariance,
        new_piece=new_piece,
        matched=rows_of(thin, match.counted(T, matches) & ~lost)
        if config.registration.mark_matched
        else None,
    )


class _Deskewed(eqx.Module):
    """The points to match, compensated by the motion that a trial pose implies."""

    points: Float[Array, "k 3"]
    time: Float[Array, " k"]
    motion: TrialMotion
    T_last: jaxlie.SE3
    """The pose at which the motion begins."""

    def __call__(self, T_world_lidar: jaxlie.SE3) -> Float[Array, "k 3"]:
        """Return the points in the lidar frame of the scan's middle."""
        return self.motion.compensated(self.points, self.time, self.T_last.inverse() @ T_world_lidar)


class _Placed(eqx.Module):
    """Compensates and places some of the points that are inserted."""

    thin: ThinnedScan
    middle: Float[Array, ""]
    twist: Float[Array, "6"]
    T_world_lidar: jaxlie.SE3
    frame: Frame

    def __call__(self, rows: Int32[Array, " n"]) -> Float[Array, "n 3"]:
        delay = self.thin.time[rows] - self.middle
        points = deskew_constant_velocity(self.thin.points[rows], delay, self.twist)
        return self.frame.place(points, self.T_world_lidar)[1]


def _imu_velocity(
    T_world_imu: jaxlie.SE3, twist: Float[Array, "6"], params: DefaultParams
) -> Float[Array, "3"]:
    """Return the IMU origin's velocity in world from the lidar's twist in its own frame."""
    in_imu = params.extrinsics.T_imu_lidar().adjoint() @ twist
    return T_world_imu.rotation() @ in_imu[:3]
