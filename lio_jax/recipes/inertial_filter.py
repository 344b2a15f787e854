"""What the recipes with an error-state filter share: the start, the prediction, and the update by a scan
match."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.error_state import (
    DOF,
    EXTRINSIC_ROTATION,
    EXTRINSIC_TRANSLATION,
    GRAVITY,
    POSITION,
    ROTATION,
    VELOCITY,
    NavEstimate,
    SweptState,
    sphere_basis,
)
from lio_jax.core.geometry import from_blocks, inverse, rotation_matrix, skew
from lio_jax.core.types import ITERATION_LIMIT, ImuBatch, NavState, Scan
from lio_jax.estimation.iterated_filter import Measurement, Update
from lio_jax.estimation.map_drift import MapDrift, error_by_planes
from lio_jax.estimation.nav_update import predicted_pose_covariance, update_nav
from lio_jax.estimation.pose_measurement import keep_observed
from lio_jax.imu.initialise import initialise_at_rest
from lio_jax.imu.path import Path
from lio_jax.imu.strapdown import propagate_sweep
from lio_jax.recipes.params import InertialParams
from lio_jax.recipes.recipe import Evidence
from lio_jax.registration.gauss_newton import Registration
from lio_jax.registration.params import FilterMatch
from lio_jax.registration.point_evidence import PointEvidence
from lio_jax.registration.scan_match import Association, NormalEquations, ScanMatch


def levelled_start(params: InertialParams, imu: ImuBatch) -> NavEstimate:
    """Return the state at the world's origin, levelled by the samples, as if the vehicle were at rest.

    Args:
        params: traced.
        imu: samples of about a second up to the first scan's end.
    """
    start = initialise_at_rest(
        imu,
        params.imu,
        params.initial,
        params.extrinsics.T_imu_lidar(),
        params.extrinsics.time_offset,
    )
    return held_at_lidar(start.start)


def held_at_lidar(state: NavEstimate) -> NavEstimate:
    """Return a first state whose lidar pose is certain: it defines the map's frame.

    If the extrinsic is off, then so is the pose of the IMU in that frame, and with it the direction in which
    the accelerometer sees gravity: R Exp(a) R_il Exp(f) and p + R (b + a x t + d) stay what they are for an
    error f, d of the extrinsic.
    """
    nav = state.nav
    R_world_imu = rotation_matrix(nav.T_world_imu.rotation())
    turn = -rotation_matrix(nav.T_imu_lidar.rotation())
    carried = from_blocks(
        (DOF, DOF),
        (slice(0, DOF), slice(0, DOF), jnp.eye(DOF, dtype=turn.dtype)),
        (ROTATION, EXTRINSIC_ROTATION, turn),
        (POSITION, EXTRINSIC_TRANSLATION, -jnp.eye(3, dtype=turn.dtype)),
        (POSITION, EXTRINSIC_ROTATION, skew(nav.T_imu_lidar.translation()) @ turn),
        (GRAVITY, EXTRINSIC_ROTATION, sphere_basis(nav.gravity).T @ R_world_imu @ turn),
    )
    covariance = carried @ state.covariance @ carried.T
    return NavEstimate(nav, (covariance + covariance.T) / 2)


def predicted(
    params: InertialParams,
    last: NavEstimate,
    scan: Scan,
    imu: ImuBatch,
    first: Bool[Array, ""],
    sweep_start: Float[Array, ""] | float = 0.0,
    rate: Float[Array, "3"] | None = None,
) -> tuple[SweptState, Path]:
    """Return the state at the scan's end and the motion since the last scan's end.

    Args:
        params: traced.
        last: at the last scan's end.
        scan: the scan to predict.
        imu: samples around the time since then.
        first: no scan was seen before.
        sweep_start: time of the scan's first point, s.
        rate: angular rate where nothing is measured, rad/s, IMU frame; None: zero.
    """
    dtype = last.covariance.dtype
    end = scan.duration.astype(dtype)
    start = jnp.where(first, 0.0, end - scan.interval.astype(dtype))
    sweep_start = jnp.asarray(sweep_start, dtype)
    moved, path = propagate_sweep(last, imu, params.imu, start, end, sweep_start, rate)
    # the first scan's end is the world's origin: its samples only deskew it
    opened = _held_at_mean(last, jnp.where(jnp.any(scan.mask), end - sweep_start, 0.0))
    return jax.tree.map(lambda new, old: jnp.where(first, old, new), moved, SweptState.at_once(opened)), path


def _held_at_mean(state: NavEstimate, sweep: Float[Array, ""]) -> NavEstimate:
    """Return a first state that is certain in its sweep's mean instead of its end.

    A wrong velocity shifts the first scan in the map by what it shifts the mean of the second by, seen from
    its end; without this correlation a vehicle that moves from the start would seem twice as fast.

    Args:
        state: at the sweep's end.
        sweep: its duration, s.
    """
    identity = jnp.eye(DOF, dtype=state.covariance.dtype)
    carried = identity.at[POSITION, VELOCITY].set(sweep / 2 * jnp.eye(3, dtype=identity.dtype))
    covariance = carried @ state.covariance @ carried.T
    return NavEstimate(state.nav, (covariance + covariance.T) / 2)


def lidar_pose(nav: NavState) -> jaxlie.SE3:
    """Return T_world_lidar."""
    return jaxlie.SE3((nav.T_world_imu @ nav.T_imu_lidar).wxyz_xyz)


class Trial(eqx.Module):
    """What one linearisation leaves to the next."""

    association: Association[Any]
    iteration: Int32[Array, ""]
    equations: NormalEquations
    degenerate: Bool[Array, " 6"]
    """Which directions were left to the prediction, weakest first."""


class _Measured(eqx.Module):
    """A scan match as a measurement of the navigation state."""

    match: ScanMatch[Any, Any]
    curvature: Float[Array, "6 6"]
    """Covariance that :func:`_curvature` returns."""

    def start(self) -> Trial:
        """Return what the first linearisation starts from."""
        dtype = self.match.T_predicted.wxyz_xyz.dtype
        nothing = NormalEquations.nothing(dtype)
        return Trial(self.match.start(), jnp.int32(0), nothing, jnp.zeros(6, jnp.bool_))

    def measure(self, nav: NavState, last: Trial) -> Measurement:
        """Search matches, anew where the scan has moved, and linearise at ``nav``."""
        association = self.match.associated(last.association, lidar_pose(nav), last.iteration)
        return self._linearised(nav, association, last.iteration)

    def again(self, nav: NavState, last: Trial) -> Measurement:
        """Linearise at ``nav`` with the matches and the kernel of the last linearisation."""
        return self._linearised(nav, last.association, last.iteration - 1)

    def _linearised(
        self, nav: NavState, association: Association[Any], iteration: Int32[Array, ""]
    ) -> Measurement:
        match, settings = self.match, self.match.registration
        assert isinstance(settings, FilterMatch)
        equations = match.linearise(lidar_pose(nav), association.found, iteration)
        information, gradient, degenerate = keep_observed(
            equations.hessian, equations.gradient, equations.arm_squared, settings.inertial_degeneracy_ratio
        )
        information = settings.information_scale * information
        softer = inverse(jnp.eye(6, dtype=information.dtype) + information @ self.curvature)
        softened = softer @ information
        return Measurement(
            information=(softened + softened.T) / 2,
            gradient=settings.information_scale * (softer @ gradient),
            lost=equations.matches < settings.min_matches,
            aux=Trial(association, iteration + 1, equations, degenerate),
            settled=match.settled(iteration),
        )


def corrected(
    prior: SweptState,
    match: ScanMatch[Any, Any],
    max_iterations: int,
    considered: Float[Array, "30 c"] | None = None,
) -> tuple[Update, NavState]:
    """Return the update by a scan match, and the state with the pose at which the scan lies on the map.

    Args:
        prior: predicted state; the match's ``T_predicted`` is its lidar pose.
        match: scan and map.
        max_iterations: bound of the loop.
        considered: covariance of the prior's error with c errors that the update does not correct.

    Returns:
        The update, whose measurement's ``aux`` is the last :class:`Trial`, and the state.
    """
    measured, settings = _Measured(match, _curvature(prior)), match.registration
    return update_nav(
        prior,
        measured.measure,
        max_iterations=max_iterations,
        rotation_tolerance=settings.rotation_tolerance,
        translation_tolerance=settings.translation_tolerance,
        first_aux=measured.start(),
        again=measured.again,
        considered=considered,
    )


def _curvature(prior: SweptState) -> Float[Array, "6 6"]:
    """Return the covariance of the lidar's pose beyond that of its linear dependence on the state.

    An extrinsic of which little is known and the IMU's pose move the lidar together. Where both are far off,
    the product of their errors counts (Jazwinski, "Stochastic processes and filtering theory", 1970, section
    9.3). Without it, scans at rest seem to tell the extrinsic.
    """
    sigma = jnp.diagonal(prior.covariance)
    turn, move = jnp.sum(sigma[EXTRINSIC_ROTATION]), jnp.sum(sigma[EXTRINSIC_TRANSLATION])
    arm = jnp.sum(prior.nav.T_imu_lidar.translation() ** 2)
    return jnp.diag(jnp.repeat(jnp.stack([turn**2, turn * (move + turn * arm)]) / 2, 3))


def registration_of(update: Update, T_world_lidar: jaxlie.SE3) -> Registration:
    """Return an update by :func:`corrected` in the terms of a Gauss-Newton solve."""
    last: Trial = update.measurement.aux
    to_body = jax.scipy.linalg.block_diag(*[rotation_matrix(T_world_lidar.rotation())] * 2)
    return Registration(
        T_world_lidar=T_world_lidar,
        information=to_body.T @ update.measurement.information @ to_body,
        degenerate=last.degenerate,
        matches=last.equations.matches,
        rmse=last.equations.rmse(),
        blur=last.equations.blur,
        iterations=update.iterations,
        status=update.status,
    )


def evidence_of(update: Update, prior: SweptState, points: PointEvidence | None = None) -> Evidence:
    """Return how well the prediction and the map agreed with a scan."""
    measured = update.measurement
    return Evidence(
        innovation=update.innovation,
        information=measured.information,
        gradient=measured.gradient,
        pose_covariance=predicted_pose_covariance(prior),
        points=points,
    )


def planes_met(update: Update, nav: NavState, share: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Return :func:`error_by_planes` of an update by :func:`corrected`; zero where the scan is lost."""
    measured = update.measurement
    used = update.status <= ITERATION_LIMIT
    return error_by_planes(
        jnp.where(used, measured.information, 0.0), measured.aux.equations.arm_squared, nav, share
    )


def after_match(
    matched: NavEstimate,
    drift: MapDrift,
    cross: Float[Array, "24 6"] | None,
    T_before: jaxlie.SE3,
    sweep: Float[Array, ""],
    begins: Bool[Array, ""],
) -> tuple[NavEstimate, MapDrift]:
    """Return state and drift after a match, as seen from the new pose.

    Where a new piece of map begins, the pose's error is moved into the drift: within the new piece the pose
    is certain. What is known of the velocity and of gravity's direction relative to the body stays known.

    Args:
        matched: state at the sweep's end; the prediction where a new piece begins.
        drift: before the match, seen from ``T_before``.
        cross: covariance of the state's error with the map's after the match; None: that of ``drift`` stays.
        T_before: pose of the state before.
        sweep: the scan's duration, s: in a new piece the pose is certain in the sweep's mean.
        begins: a new piece begins.
    """
    if cross is not None:
        drift = replace(drift, cross=cross)
    drift = drift.carried(T_before, matched.nav.T_world_imu)
    nav, covariance = matched.nav, matched.covariance
    dtype = covariance.dtype
    R_world_imu = rotation_matrix(nav.T_world_imu.rotation())
    moved = jnp.eye(DOF, dtype=dtype).at[ROTATION].set(0.0).at[POSITION].set(0.0)
    moved = moved.at[VELOCITY, ROTATION].set(skew(R_world_imu.T @ nav.velocity))
    moved = moved.at[GRAVITY, ROTATION].set(-sphere_basis(nav.gravity).T @ R_world_imu)
    moved = moved.at[POSITION, VELOCITY].set(sweep / 2 * jnp.eye(3, dtype=dtype))
    within = moved @ covariance @ moved.T
    kept = NavEstimate(nav, jnp.where(begins, (within + within.T) / 2, covariance))
    return kept, drift.with_pose_of(covariance, begins, moved)
