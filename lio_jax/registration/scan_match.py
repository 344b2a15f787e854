"""A scan match: how points are associated with a map, and how their distances are linearised at a pose."""

import abc
from collections.abc import Callable
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.geometry import dot3, rotation_matrix
from lio_jax.registration.params import RegistrationParams

_Found = TypeVar("_Found")
"""What the points were associated with, as a pytree of arrays."""


class Association(eqx.Module, Generic[_Found]):
    """What a scan was associated with and the pose at which that was found."""

    found: _Found
    T_world_lidar: jaxlie.SE3
    """Pose of the lidar at which the association was found, m."""
    arm: Float[Array, ""]
    """Root mean square distance of the points from the sensor, m: what a turn moves them by."""


def no_association(nothing: _Found, T_world_lidar: jaxlie.SE3) -> Association[_Found]:
    """Return an association that every pose is too far from."""
    nowhere = jaxlie.SE3.from_rotation_and_translation(
        T_world_lidar.rotation(), jnp.full_like(T_world_lidar.translation(), jnp.inf)
    )
    return Association(nothing, nowhere, jnp.zeros((), nowhere.wxyz_xyz.dtype))


def associated(
    last: Association[_Found],
    find: Callable[[], _Found],
    points: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    distance: Float[Array, ""],
) -> Association[_Found]:
    """Return the last association as long as the scan stays near it, else a new one.

    Args:
        last: the association so far.
        find: associates the points at ``T_world_lidar``.
        points: m, lidar frame.
        mask: which points are real.
        T_world_lidar: where the scan is now.
        distance: how far its points may have moved since ``last``, m.
    """
    turn = rotation_matrix(T_world_lidar.rotation()) - rotation_matrix(last.T_world_lidar.rotation())
    move = T_world_lidar.translation() - last.T_world_lidar.translation()
    # |R - R'| = sqrt(2) |angle| for small angles, in Frobenius' norm
    moved = jnp.linalg.norm(move) + last.arm * jnp.linalg.norm(turn) / jnp.sqrt(2.0)

    def anew() -> Association[_Found]:
        squared = jnp.where(mask, dot3(points, points), 0.0)
        arm = jnp.sqrt(jnp.sum(squared) / jnp.maximum(jnp.sum(mask), 1)).astype(last.arm.dtype)
        return Association(find(), T_world_lidar, arm)

    return jax.lax.cond(moved > distance, anew, lambda: last)


_FREE_ITERATIONS = 8
"""Iterations in which the points are matched anew after any motion beyond the distance. Most scans converge
within 4."""

_Points = TypeVar("_Points")
"""A scan's points, as a pytree of arrays."""
"""What the points were associated with, as a pytree of arrays."""


class NormalEquations(eqx.Module):
    """The distances linearised at one pose, in world axes at the sensor's position."""

    hessian: Float[Array, "6 6"]
    gradient: Float[Array, "6"]
    matches: Int32[Array, ""]
    weight: Float[Array, ""]
    """Sum of the robust weights."""
    squared_error: Float[Array, ""]
    """Robustly weighted sum of squared distances, m^2."""
    arm_squared: Float[Array, ""]
    """Mean squared distance of the points from the sensor, m^2: scales rotations to metres."""
    blur: Float[Array, ""]
    """Mean squared distance of the points from the map, robust, as a share of their squared ranges; 0 without
    matches."""

    @staticmethod
    def nothing(dtype: jnp.dtype) -> "NormalEquations":
        """Return the equations of no points."""
        zero = jnp.zeros((), dtype)
        return NormalEquations(jnp.zeros((6, 6), dtype), jnp.zeros(6, dtype), jnp.int32(0), *[zero] * 4)

    def rmse(self) -> Float[Array, ""]:
        """Return the robustly weighted root mean square distance to the map, m; 0 without matches."""
        some = (self.weight > 0) & (self.squared_error > 0)
        mean = jnp.where(some, self.squared_error, 1.0) / jnp.where(some, self.weight, 1.0)
        return jnp.where(some, jnp.sqrt(mean), 0.0)


def relative_blur(
    squared_error: Float[Array, ""], weight: Float[Array, ""], arm_squared: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the mean squared distance as a share of the mean squared range; 0 without matches.

    Args:
        squared_error: weighted sum of squared distances, m^2.
        weight: sum of the weights.
        arm_squared: mean squared range, m^2.
    """
    some = (weight > 0) & (arm_squared > 0)
    return jnp.where(some, squared_error, 0.0) / jnp.where(some, weight * arm_squared, 1.0)


class FixedPoints(eqx.Module, Generic[_Points]):
    """Points whose motion compensation does not depend on the pose under trial."""

    points: _Points

    def __call__(self, T_world_lidar: jaxlie.SE3) -> _Points:
        """Return the points, m, lidar frame."""
        return self.points


class ScanMatch(eqx.Module, Generic[_Points, _Found]):
    """A scan and what it is matched with. Its arrays may be differentiated."""

    points_at: Callable[[jaxlie.SE3], _Points]
    """The motion-compensated points in the lidar frame, m, given the pose under trial. A pytree."""
    T_predicted: jaxlie.SE3
    """Where the solve begins, in the map's world."""
    registration: RegistrationParams

    @abc.abstractmethod
    def together(self, points: _Points) -> tuple[Float[Array, "k 3"], Bool[Array, " k"]]:
        """Return all points in one array, m, lidar frame, and which of them are real."""

    @abc.abstractmethod
    def unmatched(self) -> _Found:
        """Return associations of none of the points."""

    @abc.abstractmethod
    def associate(self, points: _Points, T_world_lidar: jaxlie.SE3) -> _Found:
        """Return what each point lies on at a pose.

        Args:
            points: as :attr:`points_at` returns them for this pose.
            T_world_lidar: the pose under trial.
        """

    @abc.abstractmethod
    def linearise(
        self, T_world_lidar: jaxlie.SE3, found: _Found, iteration: Int32[Array, ""]
    ) -> NormalEquations:
        """Return the normal equations of the associated points at a pose.

        Args:
            T_world_lidar: the pose under trial.
            found: what the points are associated with.
            iteration: how many linearisations went before: a robust kernel may narrow with it.
        """

    @abc.abstractmethod
    def counted(self, T_world_lidar: jaxlie.SE3, found: _Found) -> Bool[Array, " k"]:
        """Return which of :meth:`together`'s points have a distance that counts at a pose.

        Args:
            T_world_lidar: the solution.
            found: what the points are associated with.
        """

    def settled(self, iteration: Int32[Array, ""]) -> Bool[Array, ""]:
        """Return whether the robust kernel has its own scale, so that the solve may end."""
        return jnp.array(True)

    def start(self) -> Association[_Found]:
        """Return the association before the first search."""
        return no_association(self.unmatched(), self.T_predicted)

    def associated(
        self, last: Association[_Found], T_world_lidar: jaxlie.SE3, iteration: Int32[Array, ""]
    ) -> Association[_Found]:
        """Return the last association where the scan is still near it, else a new one.

        Near means that the points have moved less than ``registration.reassociation_distance``. Where few
        points lie on planes, a scan may go to and fro between two associations without end: after some
        iterations the distance doubles with each further one, so that the solve converges for one of them.

        Args:
            last: the association so far.
            T_world_lidar: the pose under trial.
            iteration: how many iterations went before.
        """
        points = self.points_at(T_world_lidar)
        further = jnp.exp2(jnp.maximum(iteration - _FREE_ITERATIONS, 0).astype(jnp.float32))
        return associated(
            last,
            lambda: self.associate(points, T_world_lidar),
            *self.together(points),
            T_world_lidar,
            self.registration.reassociation_distance * further,
        )
