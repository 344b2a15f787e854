"""Innovations of the doubted loops of a pose graph, by the edges that are accepted so far.

A loop's residual has the covariance S = Omega^-1 + P, where P is the covariance of the relative pose of its
ends. Loops between vertices that are drawn at random tell how the residual of a wrong loop scatters, and so
by which chance a wrong one agrees.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from scipy.stats import chi2

from lio_jax.pose_graph.chordal import chordal_poses, edges_at
from lio_jax.pose_graph.descent import (
    Descent,
    Limits,
    Padded,
    descend,
    padded_poses,
    padded_weights,
    point_at,
    restricted,
)
from lio_jax.pose_graph.factors import residuals
from lio_jax.pose_graph.graph import PoseGraph, Poses, picked
from lio_jax.pose_graph.multifrontal import NotPositiveDefiniteError
from lio_jax.pose_graph.path_covariance import path_covariances
from lio_jax.pose_graph.structure import Structure

_Array = NDArray[np.float64]

_OPEN = 1e-12
"""Least eigenvalue of an information matrix, over its largest, that counts as information."""
_FARTHEST = 1e9
"""Largest residual that is distinguished from others, m."""
_FALSE_LOOPS = 4096
"""Number of drawn false loops whose residuals state how a wrong loop scatters."""


@dataclass(frozen=True, eq=False)
class DoubtedGraph:
    """A pose graph some of whose edges may be wrong."""

    graph: PoseGraph
    """Vertices and edges, without padding."""
    structure: Structure
    """Structure of the graph."""
    padded: Padded
    """The graph at its padded size."""
    doubted: NDArray[np.bool_]
    """(e,) edges that may be wrong; the others connect all vertices."""
    confidence: float
    """Share of correct edges whose r' Omega r is below :attr:`limit`."""

    @property
    def size(self) -> int:
        """Return the number of degrees of freedom of a pose."""
        return self.structure.tangent_size

    @cached_property
    def limit(self) -> float:
        """Return the largest r' Omega r of an edge that agrees, by the chi-square distribution."""
        return float(chi2.ppf(self.confidence, self.size))

    @cached_property
    def covariance(self) -> _Array:
        """Return the (e, d, d) covariances of the measurements."""
        values, vectors = np.linalg.eigh(np.asarray(self.graph.information, np.float64))
        # a direction without information is open, not exact
        values = np.maximum(values, np.maximum(_OPEN * values[:, -1:], np.finfo(np.float64).tiny ** 0.5))
        return (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)

    @cached_property
    def false_loops(self) -> PoseGraph:
        """Return doubted measurements between vertices that are drawn at random."""
        rng = np.random.default_rng(0)
        drawn = edges_at(self.graph, rng.choice(np.flatnonzero(self.doubted), _FALSE_LOOPS))
        ends = rng.integers(0, len(self.structure.held), (2, _FALSE_LOOPS)).astype(self.structure.i.dtype)
        return eqx.tree_at(lambda graph: (graph.i, graph.j), drawn, (ends[0], ends[1]))


class Accepted(NamedTuple):
    """Edges that are accepted so far, and their solution."""

    kept: NDArray[np.bool_]
    """(e,) accepted edges."""
    poses: Poses
    """Their solution, at the padded size."""
    variance: float
    """Variance of the noise, over the stated one."""
    iterations: int
    """Iterations of all descents so far."""


class Innovations(NamedTuple):
    """Residuals of loops before they are accepted."""

    squared: _Array
    """(k,) r' S^-1 r of each loop."""
    S: _Array
    """(k, d, d) covariances of the residuals."""
    false: _Array
    """(d, d) second moment of the residuals of false loops."""

    def chance(self, limit: float, variance: float) -> _Array:
        """Return the (k,) probabilities that a false loop, normally distributed, has r' S^-1 r below a limit.

        The density is taken to be that at zero, which is right for small probabilities.
        """
        size = len(self.false)
        volume = size / 2 * np.log(limit / 2) - gammaln(size / 2 + 1)
        S = variance * self.S
        among = np.linalg.slogdet(S)[1] - np.linalg.slogdet(S + self.false)[1]
        # poses beyond all numbers let anything agree
        return np.nan_to_num(np.exp(np.minimum(volume + among / 2, 0.0)), nan=1.0)


def innovations_of(problem: DoubtedGraph, state: Accepted, loops: NDArray[np.int64]) -> Innovations:
    """Return the (k,) innovations of some loops from the edges accepted so far."""
    graph = problem.padded.graph
    P = path_covariances(graph, problem.structure, problem.covariance, state.poses, state.kept, loops)
    S = problem.covariance[loops] + P
    r, false = (
        np.clip(_residuals(state.poses, each), -_FARTHEST, _FARTHEST) for each in (graph, problem.false_loops)
    )
    r = r[loops]
    squared = np.einsum("ei,ei->e", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])
    return Innovations(squared, S, false.T @ false / len(false))


@jax.jit
def _residuals(poses: Poses, graph: PoseGraph) -> jax.Array:
    return residuals(picked(poses, graph.i), picked(poses, graph.j), graph)


def solved_with(
    problem: DoubtedGraph, kept: NDArray[np.bool_], poses: Poses, limits: Limits, anew: bool
) -> Descent:
    """Descend with the kept edges only.

    Args:
        problem: the graph.
        kept: (e,) edges that are used.
        poses: poses to start from, at the padded size.
        limits: conditions that end the descent.
        anew: start from the poses that the kept edges suggest, where their cost is lower.
    """
    padded, structure = restricted(problem.graph, problem.padded, kept)
    weights = kept.astype(np.float64)
    at_padded_size = padded_weights(weights, padded)
    if anew:
        with suppress(NotPositiveDefiniteError):
            guess = chordal_poses(problem.graph, structure, weights)
            guess = padded_poses(guess, len(padded.graph.fixed))
            costs = [float(point_at(each, at_padded_size, padded).cost) for each in (guess, poses)]
            poses = guess if costs[0] < costs[1] else poses
    return descend(padded, structure, poses, at_padded_size, limits)
