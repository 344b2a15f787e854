"""The marginal likelihood of a whole recording's samples and scan matches, with richer models of a match.

A smoother's marginal likelihood takes the error of a scan match for white noise. It has other parts: the
world of the first scan is tilted by the error of its levelling, the map drifts while the vehicle drives, and
a sweep that is compensated with a predicted motion keeps the errors of that motion
(:mod:`lio_jax.imu.strapdown`). Here each part can be modelled, with states of its own and with the
correlation between a match and the link before it. The problem is linearised once, at the states that were
smoothed with white noise.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.error_state import BIASES, POSITION, ROTATION, VELOCITY
from lio_jax.core.geometry import rotation_matrix
from lio_jax.estimation.block_tridiagonal import BlockTridiagonal, factorise, log_determinant, solve
from lio_jax.estimation.chain import Chain
from lio_jax.estimation.factors import imu_information, imu_residual
from lio_jax.estimation.marginal_prior import LOG_2PI, Quadratic
from lio_jax.estimation.motion_state import DOF, POSE_DOF, MotionState, local_jacobian
from lio_jax.estimation.pose_logarithm import log_and_jacobian
from lio_jax.imu.discretise import discretise, process_noise
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import NAV_DOF, accumulate, nav_transition, sensitivity
from lio_jax.imu.sample_effects import LAG_DOF, lag_of_inputs, still_to_show
from lio_jax.imu.sampling import Intervals

WORLD_SIGMA = jnp.repeat(jnp.array([0.02, 0.001]), 3)
"""Prior standard deviations of the world's attitude and position relative to gravity's world, rad and m."""
STILL = jnp.full(POSE_DOF, 1e-6)
"""Drift of a map that does not move, rad/sqrt(s) and m/sqrt(s)."""
_LAG = slice(NAV_DOF, NAV_DOF + LAG_DOF)
_MOTION = jnp.array([*range(NAV_DOF), *range(NAV_DOF + LAG_DOF, NAV_DOF + LAG_DOF + 6)])


class Sweep(eqx.Module):
    """How a scan was compensated; one row for each scan but the first."""

    intervals: Intervals
    """Samples since the previous scan."""
    start: MotionState
    """Estimate at the previous scan's end, from which the motion was predicted."""
    span: Float[Array, "m 2"]
    """Ends of the previous scan and of this one, s from this scan's start."""


class Terms(eqx.Module):
    """A linearised recording with n scans and m = n - 1 links."""

    link_residual: Float[Array, "m 15"]
    link_jacobian: Float[Array, "m 15 30"]
    per_variance: Float[Array, "m 4 21 21"]
    """Covariance of link, lag and bias drift, per squared density."""
    match_residual: Float[Array, "n 6"]
    """Residual of each match; the first scan is matched with nothing, and its row is not used."""
    match_jacobian: Float[Array, "n 6 6"]
    lag_residual: Float[Array, "m 6"]
    """Lag according to the present estimate of the state from which the sweep was compensated."""
    lag_jacobian: Float[Array, "m 6 15"]
    by_world: Float[Array, "n 6 6"]
    """Derivative of the match by a rotation and a translation of the world's axes at the vehicle."""
    prior: Quadratic
    prior_log_scale: Float[Array, ""]
    duration: Float[Array, " m"]


class Noise(NamedTuple):
    """Arguments of the likelihood."""

    imu: ImuParams
    match: Float[Array, "6"]
    """Standard deviations of a scan match, rad then m."""
    drift: Float[Array, "6"] | None
    """Drift of the map in world axes, rad/sqrt(s) then m/sqrt(s); None if the first scan's world is exact."""


def lag_terms(sweep: Sweep) -> tuple[Float[Array, "6 15"], Float[Array, "4 21 21"]]:
    """Return the derivative of the lag by an error of the sweep's first state, and ``Terms.per_variance``."""
    intervals, (start, end) = sweep.intervals, sweep.span
    rate = intervals.gyro - sweep.start.gyro_bias
    force = intervals.accel - sweep.start.accel_bias
    increments = accumulate(intervals.duration, rate, force)
    effect = sensitivity(increments, intervals.duration, rate, force)
    times, opening = start + increments.time, jnp.zeros_like(end)
    of_inputs = lag_of_inputs(effect, (times[:-1] + times[1:]) / 2, opening, end)
    inputs = jnp.concatenate([effect.inputs, of_inputs], axis=1)

    def covariance(densities: Float[Array, "4"]) -> Float[Array, "21 21"]:
        imu = ImuParams(*densities, gravity=opening)
        noise = discretise(imu, intervals.duration, intervals.gap, intervals.known)
        return process_noise(inputs, noise, intervals.measured)

    turned = jaxlie.SO3(increments.rotation.wxyz[-1])
    elapsed = increments.time[-1]
    carried = nav_transition(turned, increments.velocity[-1], increments.position[-1], elapsed)
    _, linear, quadratic = still_to_show(start, opening, end)
    by_start = jnp.zeros((LAG_DOF, DOF)).at[:, BIASES].set(-jnp.sum(of_inputs, axis=0))
    by_start = by_start.at[POSITION, ROTATION].set(quadratic * carried[POSITION, ROTATION])
    by_start = by_start.at[POSITION, VELOCITY].set(linear * carried[POSITION, VELOCITY])
    return by_start, jax.vmap(covariance)(jnp.eye(4))


def linearised(chain: Chain, states: MotionState, sweeps: Sweep) -> Terms:
    """Return a recording's terms at states near the solution.

    Args:
        chain: chain of all scans; the information and the kernels of its scan matches are not used.
        states: states at which to linearise.
        sweeps: sweeps of all scans but the first.
    """
    start, end = (
        jax.tree.map(lambda leaf, cut=cut: leaf[cut], states) for cut in (slice(-1), slice(1, None))
    )
    links = jax.tree.map(lambda leaf: leaf[:-1], chain.imu)
    residual = jax.vmap(lambda link, a, b: imu_residual(link, chain.gravity, a, b))
    missed = jax.vmap(lambda measured, pose: log_and_jacobian(measured.inverse() @ pose))
    match_residual, match_jacobian = missed(chain.lidar.T_world_imu, states.T_world_imu)
    by_start, per_variance = jax.vmap(lag_terms)(sweeps)
    off = jax.vmap(MotionState.local)(sweeps.start, start)
    back = jnp.swapaxes(rotation_matrix(states.T_world_imu.rotation()), 1, 2)
    link_residual, link_jacobian = residual(links, start, end)
    return Terms(
        link_residual=link_residual,
        link_jacobian=link_jacobian,
        per_variance=per_variance,
        match_residual=match_residual,
        match_jacobian=match_jacobian,
        lag_residual=jnp.einsum("nij,nj->ni", by_start, off),
        lag_jacobian=by_start @ jax.vmap(local_jacobian)(sweeps.start, start),
        by_world=-jnp.kron(jnp.eye(2), back),
        prior=chain.prior.quadratic(jax.tree.map(lambda leaf: leaf[0], states), chain.prior.tilt),
        prior_log_scale=chain.prior.log_scale,
        duration=links.duration,
    )


def log_evidence(terms: Terms, noise: Noise, lag: bool) -> Float[Array, ""]:
    """Return the log marginal likelihood; ``lag``: whether sweeps keep their predicted motion's errors."""
    imu = noise.imu
    densities = jnp.stack([imu.gyro_noise, imu.accel_noise, imu.gyro_bias_walk, imu.accel_bias_walk])
    joint = jnp.einsum("k,nkij->nij", densities**2, terms.per_variance)
    information, of_links = jax.vmap(imu_information)(joint[:, _MOTION][:, :, _MOTION])
    links = _Factors(terms.link_residual, terms.link_jacobian, information)
    # the first scan has no match
    by_state, by_drift = terms.match_jacobian[1:], terms.by_world[1:]
    own = jnp.concatenate([by_state, jnp.zeros((len(by_state), POSE_DOF, DOF - POSE_DOF))], axis=2)
    residual, before = terms.match_residual[1:], jnp.zeros_like(own)
    covariance = jnp.diag(noise.match**2) + jnp.zeros_like(by_state)
    if lag:
        # conditioned on the link's residual, which is minus the noise of the motion
        across = joint[:, _LAG][:, :, _MOTION]
        gain = across @ information
        covariance += joint[:, _LAG, _LAG] - gain @ jnp.swapaxes(across, 1, 2)
        residual += jnp.einsum("nij,nj->ni", gain, terms.link_residual) - terms.lag_residual
        through = gain @ terms.link_jacobian
        before, own = through[..., :DOF] - terms.lag_jacobian, own + through[..., DOF:]
    matches = jnp.linalg.inv(covariance)
    of_matches = -jnp.linalg.slogdet(covariance)[1]
    scale = terms.prior_log_scale + jnp.sum(of_links - DOF * LOG_2PI) / 2
    scale += jnp.sum(of_matches - POSE_DOF * LOG_2PI) / 2
    prior, size = terms.prior, DOF
    hessian, gradient = prior.hessian, prior.gradient
    factors = [links, _Factors(residual, jnp.concatenate([before, own], axis=2), matches)]
    if noise.drift is not None:
        size += POSE_DOF
        nothing = jnp.zeros_like(by_drift)
        factors = [
            links.widened(
                jnp.zeros((len(of_links), DOF, POSE_DOF)), jnp.zeros((len(of_links), DOF, POSE_DOF))
            ),
            factors[1].widened(nothing, by_drift),
        ]
        walk = 1 / (noise.drift**2 * terms.duration[:, None])
        still, unit = jnp.zeros((POSE_DOF, DOF)), jnp.eye(POSE_DOF)
        steps = jnp.concatenate([still, -unit, still, unit], axis=1) + jnp.zeros((len(walk), 1, 1))
        factors.append(_Factors(jnp.zeros_like(walk), steps, walk[:, :, None] * unit))
        hessian = jax.scipy.linalg.block_diag(hessian, jnp.diag(WORLD_SIGMA**-2))
        gradient = jnp.pad(gradient, (0, POSE_DOF))
        scale += jnp.sum(jnp.log(walk) - LOG_2PI) / 2
        scale -= jnp.sum(jnp.log(WORLD_SIGMA)) + POSE_DOF / 2 * LOG_2PI
    count = len(of_links) + 1
    diagonal = jnp.zeros((count, size, size)).at[0].set(hessian)
    coupling = jnp.zeros((count - 1, size, size))
    gradients, cost = jnp.zeros((count, size)).at[0].set(gradient), prior.cost
    for factor in factors:
        square, slope, value = factor.normal()
        diagonal = diagonal.at[:-1].add(square[:, :size, :size]).at[1:].add(square[:, size:, size:])
        coupling += square[:, size:, :size]
        gradients = gradients.at[:-1].add(slope[:, :size]).at[1:].add(slope[:, size:])
        cost += value
    matrix = BlockTridiagonal((diagonal + jnp.swapaxes(diagonal, 1, 2)) / 2, coupling)
    step = -solve(*jax.lax.stop_gradient((factorise(jax.lax.stop_gradient(matrix)), gradients)))
    # at its minimum the cost has the derivative that it has with the step held constant
    curved = jnp.einsum("ni,nij,nj->", step, matrix.diagonal, step) / 2
    curved += jnp.einsum("ni,nij,nj->", step[1:], coupling, step[:-1])
    cost += jnp.sum(gradients * step) + curved
    return scale - cost + size * count / 2 * LOG_2PI - log_determinant(matrix) / 2


class _Factors(NamedTuple):
    """Residuals between neighbouring states; ``jacobian`` is by the earlier state, then by the later one."""

    residual: Float[Array, "m r"]
    jacobian: Float[Array, "m r s"]
    information: Float[Array, "m r r"]

    def widened(self, earlier: Array, later: Array) -> "_Factors":
        """Return the factors with further columns after each state's own."""
        first, second = jnp.split(self.jacobian, 2, axis=2)
        return self._replace(jacobian=jnp.concatenate([first, earlier, second, later], axis=2))

    def normal(self) -> tuple[Array, Array, Array]:
        weighted = self.information @ self.jacobian
        hessian = jnp.swapaxes(self.jacobian, 1, 2) @ weighted
        gradient = jnp.einsum("ni,nij->nj", self.residual, weighted)
        cost = jnp.einsum("ni,nij,nj->", self.residual, self.information, self.residual) / 2
        return hessian, gradient, cost
