"""Tightly coupled LiDAR-inertial odometry: an iterated error-state filter on voxel planes.

scan -> thin --------> deskew -> iterated update (match, linearise) -> insert -> map
imu  -> propagate --/------------/
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int32

from lio_jax.core.error_state import DOF, GRAVITY, NavEstimate, sphere_basis
from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.implicit import with_derivative_of
from lio_jax.core.types import ITERATION_LIMIT, ImuBatch, NavState, Scan
from lio_jax.core.xla import computed_once
from lio_jax.estimation.map_drift import MapDrift
from lio_jax.imu.path import Path, deskew_along
from lio_jax.lidar.thinning import ThinnedScan, rows_of, thinned
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.voxel_map import VoxelMap, empty_map, insert
from lio_jax.mapping.voxel_tangents import following
from lio_jax.recipes import recipe
from lio_jax.recipes.constant_velocity import mean_rate
from lio_jax.recipes.default_params import DefaultConfig, DefaultParams
from lio_jax.recipes.inertial_filter import (
    after_match,
    corrected,
    evidence_of,
    levelled_start,
    lidar_pose,
    planes_met,
    predicted,
    registration_of,
)
from lio_jax.recipes.recipe import Outage, Output
from lio_jax.registration.point_evidence import point_evidence, shown_by_noise
from lio_jax.registration.scan_match import FixedPoints
from lio_jax.registration.voxel_planes import ScanToVoxels


class InertialState(recipe.State):
    """What is carried from scan to scan."""

    nav: NavState
    """State at the last scan's end."""
    covariance: Float[Array, "24 24"]
    """Covariance of the state's error within the map."""
    drift: MapDrift
    prediction_error: Float[Array, ""]
    """Expected error of the next prediction, m; the robust kernel is wide enough for it."""
    scans: Int32[Array, ""]
    """Number of scans with points so far."""
    rate: Float[Array, "3"]
    """Mean angular rate between the last two scans' ends, rad/s, IMU frame."""
    unmatched: Float[Array, ""]
    """Time since the last scan that was matched, s."""
    map: VoxelMap

    @property
    def estimate(self) -> NavEstimate:
        """The navigation state and its covariance."""
        return NavEstimate(self.nav, self.covariance)

    def varying_map(self) -> VoxelMap:
        """Return which leaves of the map have a derivative: the moments."""
        return self.map.varying()

    def with_velocity_of(self, found: "InertialState") -> "InertialState":
        """Return this first state with the velocity and the rate of a later one."""
        return eqx.tree_at(lambda one: (one.nav.velocity, one.rate), self, (found.nav.velocity, found.rate))


def init(config: DefaultConfig, params: DefaultParams, imu: ImuBatch) -> InertialState:
    """Return the state before the first scan: at the world's origin, levelled by the samples.

    Args:
        config: static.
        params: traced.
        imu: samples of about a second up to the first scan's end.
    """
    start = levelled_start(params, imu)
    dtype = start.covariance.dtype
    return InertialState(
        nav=start.nav,
        covariance=start.covariance,
        drift=MapDrift.none(dtype),
        prediction_error=jnp.asarray(params.motion.initial_error, dtype),
        scans=jnp.int32(0),
        rate=jnp.zeros_like(start.nav.velocity),
        unmatched=jnp.zeros((), dtype),
        map=empty_map(config.map.capacity),
    )


def placed(state: InertialState, T_world_imu: jaxlie.SE3) -> InertialState:
    """Return a state before the first scan at another pose, in the world of a known map.

    Errors are perturbations in the body's axes and stay what they are, but for the direction of gravity,
    whose axes are those of the world. The pose is no longer certain.

    Args:
        state: of :func:`init`.
        T_world_imu: in the map's world, whose z axis points upwards.
    """
    nav = state.nav
    turn = rotation_matrix(T_world_imu.rotation() @ nav.T_world_imu.rotation().inverse())
    basis = sphere_basis(nav.gravity)
    carried = jnp.eye(DOF, dtype=turn.dtype).at[GRAVITY, GRAVITY].set(basis.T @ turn @ basis)
    covariance = recipe.placed_covariance(carried @ state.covariance @ carried.T)
    return eqx.tree_at(lambda one: (one.nav, one.covariance), state, (nav.at_pose(T_world_imu), covariance))


def step(
    config: DefaultConfig, params: DefaultParams, state: InertialState, scan: Scan, imu: ImuBatch
) -> tuple[InertialState, Output]:
    """Predict by the inertial samples, correct by the scan, add the scan to the map.

    Args:
        config: static.
        params: traced.
        state: donate it.
        scan: padded sweep; ``scan.interval`` is the time since the last scan's end.
        imu: samples around that time.
    """
    first = state.scans == 0
    spacing = params.registration.inertial_point_spacing
    sizes = config.imu.insertion_points, config.imu.registration_points
    thin = thinned(params.lidar, scan, params.map.point_spacing, spacing, *sizes)
    with jax.named_scope("predict"):
        rate = state.rate * Outage.turning(params, state.unmatched, scan)
        prior, path = predicted(params, state.estimate, scan, imu, first, rate=rate)
        T_predicted = lidar_pose(prior.nav)
        still = jax.lax.stop_gradient((path, prior.nav.T_imu_lidar, thin.points))
        points = deskew_along(*still, thin.time)
        to_match = _to_match(path, prior.nav.T_imu_lidar, thin, points)
        outage = Outage.at(params, state.unmatched + scan.interval, thin.matched.mask)
    with jax.named_scope("update"):
        match = ScanToVoxels(
            points_at=FixedPoints(to_match),
            T_predicted=T_predicted,
            registration=outage.required(params.registration),
            map=state.map,
            mask=thin.matched.mask,
            prediction_error=state.prediction_error,
            map_params=params.map,
            lidar=params.lidar,
            least_width=params.registration.least_width,
        )
        considered = prior.transition @ state.drift.cross
        update, matched = corrected(prior, match, config.registration.max_iterations, considered)
        posterior: NavEstimate = update.state
        lost = (update.status > ITERATION_LIMIT) & ~first
        new_piece = outage.begins_piece(lost, params.registration)
        T_world_lidar, T_matched = lidar_pose(posterior.nav), lidar_pose(matched)
        frame, matches = match.frame(), update.measurement.aux.association.found
        sigmas = params.lidar, params.registration
        coordinates = matches.coordinates_in(state.map)
        slots = len(state.map.voxel)
        evidence = point_evidence(slots, matches, to_match, T_matched, frame, *sigmas, coordinates)
        by_noise = shown_by_noise(
            state.map,
            matches,
            to_match,
            T_matched,
            frame,
            params.lidar,
            params.registration.kernel,
            update.measurement.aux.equations,
        )
        missed = jnp.linalg.norm((T_predicted.inverse() @ T_matched).translation())
        error = jnp.maximum(params.motion.error_decay * state.prediction_error, missed)
    with jax.named_scope("insert"):
        _, placed = jax.lax.stop_gradient(frame.place(points, T_matched))
        inserted, size = thin.mask & (~lost | new_piece), params.map.voxel_size.astype(jnp.float32)
        # XLA copies a map that is read after it is written: what has read it comes first
        inserted, by_noise = computed_once((inserted, by_noise))
        vmap, added = insert(
            state.map,
            placed,
            inserted,
            frame.anchor,
            size,
            params.map.reach.astype(jnp.float32),
            T_matched.translation() - frame.origin,
        )
        again = _PlacedAgain(path, prior.nav.T_imu_lidar, thin, T_matched, frame)
        vmap = following(vmap, state.map, added.added, placed, inserted, again, frame.anchor, size)

        new = jnp.sum(added.added) / jnp.maximum(jnp.sum(thin.mask), 1)
        before, cross = state.nav.T_world_imu, update.considered
        within, drift = after_match(posterior, state.drift, cross, before, scan.duration, new_piece)
        by_planes = planes_met(update, posterior.nav, evidence.plane_share)
        after, grown = drift.grown(within, new, by_planes, state.scans)

    new_state = InertialState(
        nav=within.nav,
        covariance=after.covariance,
        drift=grown,
        # it only opens the kernel, which is closed at the solution
        prediction_error=jax.lax.stop_gradient(
            jnp.select(
                [new_piece, first | lost], [params.motion.initial_error, state.prediction_error], error
            )
        ),
        scans=state.scans + jnp.any(thin.mask).astype(jnp.int32),
        rate=jnp.where(first | lost, rate, mean_rate(state.nav, posterior.nav, scan)),
        unmatched=outage.after((first & ~jnp.any(thin.mask)) | (lost & ~new_piece)),
        map=vmap,
    )
    return new_state, Output(
        registration=registration_of(update, T_world_lidar),
        lost=lost,
        nis=update.innovation.nis,
        nis_dof=update.innovation.dof,
        points=placed,
        points_mask=thin.mask,
        added=added.added,
        origin=frame.origin,
        thinned_away=thin.dropped,
        map_dropped=added.dropped,
        covariance=drift.added_to(within),
        new_piece=new_piece,
        evidence=evidence_of(update, prior, evidence),
        shown_by_noise=by_noise,
        matched=rows_of(thin, match.counted(T_matched, matches) & ~lost)
        if config.registration.mark_matched
        else None,
    )


class _PlacedAgain(eqx.Module):
    """Compensates and places some of the points that were inserted, for their derivative."""

    path: Path
    T_imu_lidar: jaxlie.SE3
    thin: ThinnedScan
    T_world_lidar: jaxlie.SE3
    frame: Frame

    def __call__(self, rows: Int32[Array, " n"]) -> Float[Array, "n 3"]:
        points = deskew_along(self.path, self.T_imu_lidar, self.thin.points[rows], self.thin.time[rows])
        return self.frame.place(points, self.T_world_lidar)[1]


def _to_match(
    path: Path, T_imu_lidar: jaxlie.SE3, thin: ThinnedScan, deskewed: Float[Array, "m 3"]
) -> Float[Array, "k 3"]:
    """Return the compensated points to match: only these few need a derivative."""
    index = thin.matched.index
    return with_derivative_of(
        deskewed[index], deskew_along, path, T_imu_lidar, thin.points[index], thin.time[index]
    )
