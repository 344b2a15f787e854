"""Gauss-Newton steps on a pose graph, damped where they fail (Levenberg and Marquardt)."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.loops.block_cholesky import factorise, solve
from lio_jax.loops.graph import Poses, Status
from lio_jax.loops.multifrontal import NotPositiveDefiniteError
from lio_jax.loops.normal_equations import Padded, Point, point_after
from lio_jax.loops.structure import Structure

_LEAST_DAMPING, _LARGEST_DAMPING = 1e-10, 1e8
"""Relative to the diagonal of the normal equations."""
_FAITHFUL = 0.5
"""A step that gains this share of what it promised may be followed by a less damped one."""
_ROUNDING = 1e-12
"""Relative; smaller changes of the cost may be those of its sum."""
_NEGLIGIBLE_PER_EDGE = 1e-14
"""A decrease of the cost that is only rounding, where all edges agree."""


@dataclass(frozen=True)
class Limits:
    """When a descent ends."""

    iterations: int = 100
    """Linear systems at most."""
    tolerance: float = 1e-8
    """Converged when a step promises to lower the cost by less than this share; that step is still made."""


class Descent(NamedTuple):
    """Where a descent ended."""

    point: Point
    iterations: int
    status: Status


def descend(
    padded: Padded, structure: Structure, poses: Poses, weights: Float[Array, " e"], limits: Limits
) -> Descent:
    """Return the poses of least cost near the given ones.

    Plain Gauss-Newton steps while they lower the cost; else the diagonal is raised by a share of itself, the
    more the more steps fail in a row, and by a tenth of it after each one that keeps its promise (Marquardt,
    "An algorithm for least-squares estimation of nonlinear parameters", 1963).

    Args:
        padded: the graph.
        structure: of the graph.
        poses: (n,) to start from, of the padded size.
        weights: of the edges, of the padded size.
        limits: when to end.
    """
    step = np.zeros((len(padded.places.unknown) + 1, structure.tangent_size), padded.graph.information.dtype)
    point = point_after(poses, jax.device_put(step), weights, padded)
    cost, damping, iterations = float(point.cost), 0.0, 0
    if not np.isfinite(cost):
        return Descent(point, 0, "not finite")
    equations, failures = Equations.at(point, structure), 0
    while structure.count and iterations < limits.iterations:
        iterations += 1
        negligible = limits.tolerance * cost + _NEGLIGIBLE_PER_EDGE * len(structure.i)
        try:
            step[: structure.count], promised = equations.solved(damping)
            tried = point_after(point.poses, jax.device_put(step), weights, padded)
            gained = cost - float(tried.cost)
        except NotPositiveDefiniteError:
            promised = gained = -np.inf
        last = damping == 0 and 0 <= promised <= negligible
        if gained >= 0:
            point, cost, failures = tried, float(tried.cost), 0
            if last or max(gained, promised) <= negligible:
                return Descent(point, iterations, "converged")
            equations = Equations.at(point, structure)
            if gained > _FAITHFUL * promised:
                damping = damping / 10 if damping > _LEAST_DAMPING else 0.0
        elif last or (promised >= 0 and max(promised, -gained) <= _ROUNDING * cost):
            return Descent(point, iterations, "converged")
        else:
            failures += 1
            damping = max(damping, _LEAST_DAMPING) * 10.0**failures
            if damping > _LARGEST_DAMPING:
                return Descent(point, iterations, "no further decrease")
    return Descent(point, iterations, "iteration limit" if structure.count else "converged")


@dataclass(frozen=True)
class Equations:
    """The normal equations H dx = -g on the host, without padding."""

    structure: Structure
    diagonal: NDArray[np.float64]
    """(n, d, d)."""
    pairs: NDArray[np.float64]
    """(m, d, d)."""
    gradient: NDArray[np.float64]
    """(n, d)."""

    @staticmethod
    def at(point: Point, structure: Structure) -> "Equations":
        """Take over what was assembled on the device."""
        blocks, gradient = jax.device_get((point.blocks, point.gradient))
        first = len(gradient)
        return Equations(
            structure,
            blocks[: structure.count].astype(np.float64, copy=False),
            blocks[first : first + len(structure.pairs)].astype(np.float64, copy=False),
            gradient[: structure.count].astype(np.float64, copy=False),
        )

    def solved(self, damping: float) -> tuple[NDArray[np.float64], float]:
        """Return the step and by how much it lowers the cost of the linearised graph.

        Raises:
            NotPositiveDefiniteError: H is singular, as far as numbers tell.
        """
        scale = np.diagonal(self.diagonal, axis1=1, axis2=2)
        added = damping * np.maximum(scale, 1e-6 * scale.max(initial=0.0))
        diagonal = self.diagonal
        if damping:
            diagonal = diagonal + added[:, :, None] * np.eye(added.shape[-1])
        factor = factorise(self.structure.plan, diagonal, self.pairs)
        step = solve(factor, -self.gradient)
        # H dx = -g - D dx with D the damping: the model falls by -g'dx - dx'H dx / 2 = (-g'dx + dx'D dx) / 2
        return step, float(-np.sum(self.gradient * step) + np.sum(added * step**2)) / 2
