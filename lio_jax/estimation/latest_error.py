"""The covariance of a window's latest state in the world, where the map that its poses are measured in is
wrong itself.

The window takes each scan match for a measurement of the pose in the world. But a match measures the pose
within the map around the vehicle, whose own error m it repeats, and points that are added to the map put the
pose's error into it (:mod:`lio_jax.estimation.map_drift` describes the model). Let e be the error of the
latest state, and P its covariance as the window states it. A match with the information A has the gain
K = P H' A, so that

    e' = (I - K H) (F e + w) + K (m + n),        m' = (1 - f) m + f H e' + n_planes,

with the derivative F and the noise w of the inertial samples, the match's own noise n, and the share f of a
scan's points that are new to the map. This is the covariance of an estimator that does not estimate m, with
m considered beside it (Schmidt, "Application of state-space methods to navigation problems", 1966). Without
an error of the map it is P, as the marginal of a window's latest state is that of a filter.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.core.geometry import adjoint
from lio_jax.estimation.factors import FLOOR, residual_with_tilt
from lio_jax.estimation.innovation import Innovation, innovation_of, square_root_information
from lio_jax.estimation.motion_state import DOF, POSE_DOF, MotionState
from lio_jax.imu.preintegration import Preintegrated


class LatestError(eqx.Module):
    """The joint covariance of the latest state's error and of the map's error."""

    state: Float[Array, "p p"]
    """Covariance of the errors of the latest state and of the tilt of gravity, p = 15 + q."""
    cross: Float[Array, "p 6"]
    """Covariance of these errors with the map's error."""
    map: Float[Array, "6 6"]
    """Covariance of the map's error, as a right perturbation of the IMU's pose: rotation (rad) before
    translation (m)."""

    @staticmethod
    def of(state: Float[Array, "p p"]) -> "LatestError":
        """Return the covariance of a state in a map without an error."""
        nothing = jnp.zeros((POSE_DOF, POSE_DOF), state.dtype)
        return LatestError(state, jnp.zeros((len(state), POSE_DOF), state.dtype), nothing)

    def propagated(
        self,
        link: Preintegrated,
        gravity: Float[Array, "3"],
        tilt: Float[Array, " q"],
        start: MotionState,
        end: MotionState,
    ) -> "LatestError":
        """Return the covariance of the state that follows by inertial samples.

        Args:
            link: preintegrated samples between the states.
            gravity: m/s^2, in world, without the tilt.
            tilt: of gravity, rad.
            start: the state before.
            end: the state.
        """
        residual, jacobian = residual_with_tilt(link, gravity, tilt, start, end)
        by_start, by_end, by_fall = jnp.split(jacobian, (DOF, 2 * DOF), axis=1)
        identity = jnp.eye(DOF, dtype=residual.dtype)
        solved = -jnp.linalg.solve(by_end, jnp.concatenate([by_start, by_fall, identity], axis=1))
        size = len(self.state)
        carry = jnp.eye(size, dtype=residual.dtype).at[:DOF].set(solved[:, :size])
        noise = link.covariance + jnp.diag(jnp.asarray(FLOOR, residual.dtype) ** 2)
        grown = solved[:, size:] @ noise @ solved[:, size:].T
        state = (carry @ self.state @ carry.T).at[:DOF, :DOF].add(grown)
        seen = adjoint(end.T_world_imu.inverse() @ start.T_world_imu)
        return LatestError(_symmetric(state), carry @ self.cross @ seen.T, seen @ self.map @ seen.T)

    def innovation(self, missed: Float[Array, "6"], information: Float[Array, "6 6"]) -> Innovation:
        """Return how well a match agrees with the prediction of which this is the covariance.

        Args:
            missed: logarithm of the matched pose as seen from the predicted one, rad before m.
            information: of the match.
        """
        pose = slice(0, POSE_DOF)
        across = self.cross[pose]
        apart = self.state[pose, pose] + self.map - across - across.T
        root, residual, values = square_root_information(information, information @ missed)
        return innovation_of(root.T @ apart @ root, residual, values)

    def matched(self, window: Float[Array, "p p"], information: Float[Array, "6 6"]) -> "LatestError":
        """Return the covariance after a match.

        Args:
            window: covariance of the state and of the tilt after the match as the window states it.
            information: of the match; zero without one.
        """
        gain = window[:, :POSE_DOF] @ information
        kept = jnp.eye(len(window), dtype=window.dtype).at[:, :POSE_DOF].add(-gain)
        taken = gain @ self.map @ gain.T + gain @ window[:POSE_DOF]
        mixed = kept @ self.cross @ gain.T
        state = kept @ self.state @ kept.T + mixed + mixed.T + taken
        return LatestError(_symmetric(state), kept @ self.cross + gain @ self.map, self.map)

    def added(self, share: Float[Array, ""], noise: Float[Array, "6 6"]) -> "LatestError":
        """Return the covariance after a scan was added to the map at the state's pose.

        Args:
            share: share of the scan's points that take the pose's error into the map, 0 to 1.
            noise: covariance of the new planes' error; both by
                :func:`~lio_jax.estimation.map_drift.taken_into_map`.
        """
        pose, old = slice(0, POSE_DOF), 1 - share
        across = old * share * self.cross[pose]
        in_map = old**2 * self.map + across + across.T + share**2 * self.state[pose, pose] + noise
        cross = old * self.cross + share * self.state[:, pose]
        return LatestError(self.state, cross, _symmetric(in_map))

    def turned(self, turn: Float[Array, "q q"]) -> "LatestError":
        """Return the covariance in another world, in which the axes of the tilt are turned."""
        unknowns = jax.scipy.linalg.block_diag(jnp.eye(DOF, dtype=turn.dtype), turn)
        return LatestError(unknowns @ self.state @ unknowns.T, unknowns @ self.cross, self.map)


def unless(condition: Bool[Array, ""], other: LatestError, error: LatestError) -> LatestError:
    """Return ``error``, or ``other`` where the condition holds."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), other, error)


def _symmetric(covariance: Array) -> Array:
    return (covariance + covariance.T) / 2
