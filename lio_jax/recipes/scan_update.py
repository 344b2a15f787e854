"""The iterated filter's update by a scan match: the match as a measurement of the navigation state."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Int32

from lio_jax.core.error_state import SweptState
from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.types import NavState
from lio_jax.estimation.iterated_filter import Measurement, Update
from lio_jax.estimation.nav_update import predicted_pose_covariance, update_nav
from lio_jax.estimation.pose_measurement import keep_observed
from lio_jax.recipes.inertial_filter import lidar_pose
from lio_jax.recipes.output import Evidence
from lio_jax.registration.association import Association
from lio_jax.registration.gauss_newton import Registration
from lio_jax.registration.params import FilterMatch
from lio_jax.registration.point_evidence import PointEvidence
from lio_jax.registration.scan_match import NormalEquations, ScanMatch


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

    def start(self) -> Trial:
        """Return what the first linearisation starts from."""
        dtype = self.match.T_predicted.wxyz_xyz.dtype
        nothing = NormalEquations.nothing(dtype)
        return Trial(self.match.start(), jnp.int32(0), nothing, jnp.zeros(6, jnp.bool_))

    def measure(self, nav: NavState, last: Trial) -> Measurement:
        """Search matches, anew where the scan has moved, and linearise at ``nav``."""
        association = self.match.associated(last.association, lidar_pose(nav))
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
        return Measurement(
            information=settings.information_scale * information,
            gradient=settings.information_scale * gradient,
            lost=equations.matches < settings.min_matches,
            aux=Trial(association, iteration + 1, equations, degenerate),
            settled=match.settled(iteration),
        )


def corrected(prior: SweptState, match: ScanMatch[Any, Any], max_iterations: int) -> tuple[Update, NavState]:
    """Return the update by a scan match, and the state with the pose at which the scan lies on the map.

    Args:
        prior: predicted state; the match's ``T_predicted`` is its lidar pose.
        match: scan and map.
        max_iterations: bound of the loop.

    Returns:
        The update, whose measurement's ``aux`` is the last :class:`Trial`, and the state.
    """
    measured, settings = _Measured(match), match.registration
    return update_nav(
        prior,
        measured.measure,
        max_iterations=max_iterations,
        rotation_tolerance=settings.rotation_tolerance,
        translation_tolerance=settings.translation_tolerance,
        first_aux=measured.start(),
        again=measured.again,
    )


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
