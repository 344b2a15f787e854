"""Select the loops of a pose graph that agree, those first which a wrong loop could hardly imitate.

A loop is compared with the poses that the edges accepted so far determine. Its residual has the covariance
S = Omega^-1 + P, where P is the covariance of the relative pose of its ends (the innovation of a filter). A
short loop has a small S, so a wrong loop there agrees by chance only rarely; a loop over a long drift agrees
with anything. Loops are accepted in the order of that chance, as long as few of those accepted are expected
to be wrong. Each acceptance makes the graph stiffer and the next loops easier to judge. Accepted loops that
the solution contradicts are dropped again.

A few loops are all tried together first. A few tight loops can bend a loose odometry until every one of them
agrees, so the odometry's own cost has to be as low as the degrees of freedom allow. If it is not, the loops
are judged by their innovations from the trusted edges alone, which no wrong loop has bent yet.

The idea to accept measurements by their joint consistency is that of Neira & Tardos, "Data association in
stochastic mapping using the joint compatibility test", T-RA 2001, and of Latif, Cadena & Neira, "Robust loop
closing over time for pose graph SLAM", IJRR 2013. The order by the chance of a false agreement is our own.
"""

from math import ceil

import equinox as eqx
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lio_jax.pose_graph.descent import Descent, Limits, Padded
from lio_jax.pose_graph.graph import PoseGraph, Poses
from lio_jax.pose_graph.leave_one_out import falls_without
from lio_jax.pose_graph.loop_innovations import (
    Accepted,
    DoubtedGraph,
    Innovations,
    innovations_of,
    solved_with,
)
from lio_jax.pose_graph.multifrontal import NotPositiveDefiniteError
from lio_jax.pose_graph.structure import Structure, structure_of

_Array = NDArray[np.float64]

_EXPECTED_WRONG = (2e-4, 1e-3, 5e-3, 2e-2)
"""Expected shares of wrong loops among those accepted in one round; the strictest one that accepts enough."""
_EXPECTED_WRONG_AS_STATED = _EXPECTED_WRONG[:3]
"""The same, where the residuals may be as large as the stated information allows."""
_ENOUGH = 0.05
"""Least share of the loops that agree which a round accepts before the next expected share is tried."""
_ROUNDS = 200
"""Largest number of rounds."""
_CHANCES = 2
"""Number of times that a loop may be dropped before it is left out for good."""
_FEW = 0.25
"""Number of doubted edges, over that of the trusted ones, up to which all are tried at once: many wrong loops
would couple everything with everything, and the solve would take long."""
_ENOUGH_FOR_SCALE = 5
"""Least number of loops whose innovations tell how much larger the trusted edges' noise is than stated."""
_MANY_MORE = 1.1
"""Loops that the trusted edges allow are taken if there are this many times more than can be told from wrong
ones: a group of wrong ones that agree with each other may be among them."""
_SURELY_RIGHT = 0.5
"""Share of the loops that are right, and agree best, in the estimate of that noise."""
_LEFT_OUT = 0.1, 5
"""Largest share and number of a few loops that are left out one after the other, each time the worst one.
Where more are wrong, they hide each other."""
_ON_THE_WAY = Limits(iterations=50, tolerance=1e-4)
"""Conditions that end the descents before the last one."""
_WORST = 0.25
"""Loops are dropped together if their residual is above this share of the largest."""
_STATED = 60.0
"""Degrees of freedom with which the stated information counts in the estimate of the noise."""
_HALVINGS = 24
"""Number of variances of the noise that are compared in the first round, each half of the one before."""
_ALMOST_ALL = 0.9
"""Share of the right loops that agree with the variance of the first round."""
_TRIALS = 10
"""Largest number of loops that are tried for the sake of others."""
_TRIED = 0.05
"""Largest chance of a false agreement of a loop that is tried."""
_SUPPORT = 3.0, 10.0, 1e-3
"""A tried loop stays if it lets this number of others agree, and this multiple of those expected by chance,
where only loops count that agree by chance with less than the last number."""


def select(
    graph: PoseGraph,
    structure: Structure,
    padded: Padded,
    poses: Poses,
    doubted: NDArray[np.bool_],
    confidence: float,
    limits: Limits,
) -> tuple[Descent, _Array]:
    """Return the poses of the edges that agree.

    The noise may be smaller than stated, as it is in many graphs; its variance is estimated from the accepted
    edges, and a loop must agree with it. At the end loops are accepted, too, that agree with the information
    as it is stated.

    Args:
        graph: vertices and edges, without padding.
        structure: structure of the graph.
        padded: the graph at its padded size.
        poses: poses of the trusted edges, at the padded size.
        doubted: (e,) edges between two vertices that may be wrong; the others connect all vertices.
        confidence: share of correct edges whose r' Omega r is below the limit, by the chi-square
            distribution.
        limits: conditions that end the last descent.

    Returns:
        The last descent, with the count of iterations of all descents, and the (e,) weight of each edge: 1 if
        it agrees, else 0.
    """
    problem = DoubtedGraph(graph, structure, padded, doubted, confidence)
    state = Accepted(~doubted, poses, 1.0, 0)
    few = np.sum(doubted) <= _FEW * np.sum(~doubted)
    # a damaged file may place vertices beyond all numbers
    with np.errstate(over="ignore", invalid="ignore"):
        state = _of_few(problem, state) if few else _of_many(problem, state)
    descent = solved_with(problem, state.kept, state.poses, limits, anew=False)
    iterations = state.iterations + descent.iterations
    return descent._replace(iterations=iterations), state.kept.astype(np.float64)


def _of_many(problem: DoubtedGraph, state: Accepted) -> Accepted:
    """Return the state with the loops that can be told from wrong ones."""
    state = _grown(problem, state, _EXPECTED_WRONG, stated=False)
    return _as_stated(problem, state)


def _as_stated(problem: DoubtedGraph, state: Accepted) -> Accepted:
    return _grown(problem, state._replace(variance=1.0), _EXPECTED_WRONG_AS_STATED, stated=True)


def _of_few(problem: DoubtedGraph, state: Accepted) -> Accepted:
    """Return the state with all loops if they agree, else with those that can be told from wrong ones.

    A few right loops may not support each other enough for that. Then those are taken that the trusted edges
    allow, less the worst, if these are many more.

    Half of the loops are taken to be right: if the median of their innovations is larger than stated, it is
    the trusted edges that are less certain than they state. Fewer than five loops do not tell that.
    """
    loops = np.flatnonzero(problem.doubted)
    if not len(loops):
        return state
    judged, innovations = problem, innovations_of(problem, state, loops).squared
    scale = np.quantile(innovations, _SURELY_RIGHT / 2, method="lower") / chi2.median(problem.size)
    if len(loops) >= _ENOUGH_FOR_SCALE and 1.0 < scale < np.inf:
        judged = _loosened(problem, scale)
        innovations = innovations_of(judged, state, loops).squared
    after, squared = _with(judged, state, loops)
    if _agree(judged, after, squared):
        return after
    told = _of_many(problem, state)
    allowed = _without_the_worst(judged, state, loops[innovations <= problem.limit])
    if allowed is None:
        return told
    allowed = _as_stated(judged, allowed)
    counts = [np.sum(each.kept[loops]) for each in (allowed, told)]
    return allowed if counts[0] > _MANY_MORE * counts[1] else told


def _loosened(problem: DoubtedGraph, scale: float) -> DoubtedGraph:
    """Return the problem with the information of its trusted edges divided by a scale."""

    def loose(graph: PoseGraph) -> PoseGraph:
        by = np.ones(len(graph.i))
        by[: len(problem.doubted)][~problem.doubted] = 1 / scale
        return eqx.tree_at(lambda graph: graph.information, graph, graph.information * by[:, None, None])

    padded = problem.padded._replace(graph=loose(problem.padded.graph))
    return DoubtedGraph(loose(problem.graph), problem.structure, padded, problem.doubted, problem.confidence)


def _with(problem: DoubtedGraph, state: Accepted, loops: NDArray[np.int64]) -> tuple[Accepted, _Array]:
    """Return the state with some loops more, and r' Omega r of all edges."""
    kept = state.kept.copy()
    kept[loops] = True
    descent = solved_with(problem, kept, state.poses, _ON_THE_WAY, anew=True)
    squared = 2 * np.asarray(descent.point.edge_costs)[: len(kept)]
    return Accepted(kept, descent.point.poses, state.variance, state.iterations + descent.iterations), squared


def _freedom(problem: DoubtedGraph, state: Accepted) -> int:
    """Return the degrees of freedom of the sum of all r' Omega r; at least 1."""
    return max(problem.size * int(np.sum(state.kept) - problem.structure.count), 1)


def _agree(problem: DoubtedGraph, state: Accepted, squared: _Array) -> bool:
    """Return whether no accepted loop contradicts the others, and the loops did not bend the trusted edges.

    Right loops leave the trusted edges a sum of squares below that of all degrees of freedom.
    """
    most = float(chi2.ppf(problem.confidence, _freedom(problem, state)))
    worst = squared[problem.doubted & state.kept].max(initial=0.0)
    return bool(worst <= problem.limit and squared[~problem.doubted].sum() <= most)


def _without_the_worst(problem: DoubtedGraph, state: Accepted, loops: NDArray[np.int64]) -> Accepted | None:
    """Return the state with some loops but the worst of them; None if too many would have to go.

    The worst one is that without which the cost falls most. Its fall is its squared innovation from all other
    edges, so the largest fall has to agree with their noise, which may be smaller than stated.
    """
    share, most = _LEFT_OUT
    for _ in range(1 + min(ceil(share * len(loops)), most)):
        if not len(loops):
            return state
        after, squared = _with(problem, state, loops)
        chain = structure_of(problem.graph, after.kept)
        try:
            falls = falls_without(after.poses, problem.padded.graph, chain, after.kept, loops)
        except (NotPositiveDefiniteError, np.linalg.LinAlgError):
            return None
        freedom = _freedom(problem, after)
        variance = min(1.0, float(squared[after.kept].sum() + _STATED) / (freedom + _STATED))
        limit = chi2.isf((1 - problem.confidence) / len(loops), problem.size)
        if falls.max() <= limit * variance and _agree(problem, after, squared):
            return after
        loops = np.delete(loops, np.argmax(falls))
        state = state._replace(poses=after.poses, iterations=after.iterations)
    return None


def _grown(problem: DoubtedGraph, state: Accepted, shares: tuple[float, ...], stated: bool) -> Accepted:
    """Accept loops round by round, until no more can be told from wrong ones."""
    dropped = np.zeros(len(state.kept), np.int64)
    trials = 0 if stated else _TRIALS
    for number in range(_ROUNDS):
        waiting = np.flatnonzero(problem.doubted & ~state.kept & (dropped < _CHANCES))
        if not len(waiting):
            break
        found = innovations_of(problem, state, waiting)
        if number == 0 and not stated:
            state = state._replace(variance=_first_variance(found, problem))
        chance = found.chance(problem.limit, state.variance)
        agrees = found.squared <= problem.limit * state.variance
        chosen = waiting[_sure(chance, agrees, shares)]
        if not len(chosen) and np.all(agrees):
            # nothing contradicts anything
            chosen = waiting
        if len(chosen):
            after = _accepting(problem, state, chosen, stated)
        else:
            hopeful = np.flatnonzero(agrees & (chance < _TRIED))
            hopeful = waiting[hopeful[np.argsort(chance[hopeful], kind="stable")]]
            after, used = _supported(problem, state, hopeful[:trials], waiting[chance < _SUPPORT[2]])
            dropped[hopeful[:used]] = _CHANCES
            trials -= used
            if after is state:
                break
        tried = state.kept.copy()
        tried[chosen] = True
        dropped[tried & ~after.kept] += 1
        state = after
    return state


def _sure(chance: _Array, agrees: NDArray[np.bool_], shares: tuple[float, ...]) -> NDArray[np.int64]:
    """Return the agreeing loops up to a chance at which few of them are expected to be wrong."""
    order = np.argsort(chance, kind="stable")
    false, good = np.cumsum(chance[order]), np.cumsum(agrees[order])
    last: NDArray[np.int64] = np.zeros(0, np.int64)
    for share in shares:
        last = np.flatnonzero((false <= share * good) & agrees[order])
        if len(last) and good[last[-1]] >= _ENOUGH * good[-1]:
            break
    if not len(last):
        return last
    taken = order[: last[-1] + 1]
    return taken[agrees[taken]]


def _supported(
    problem: DoubtedGraph, state: Accepted, hopeful: NDArray[np.int64], sure: NDArray[np.int64]
) -> tuple[Accepted, int]:
    """Try loops until one lets others agree; return the state with it, and the number of loops tried.

    Loops at the end of a long drift cannot be told from wrong ones alone. A right one makes its neighbours
    agree, a wrong one does not.

    Args:
        problem: the graph.
        state: edges accepted so far.
        hopeful: loops to try, in this order.
        sure: loops that could be judged without the tried one.
    """
    least, multiple, chance_below = _SUPPORT
    for tried, loop in enumerate(hopeful):
        after = _accepting(problem, state, np.array([loop]), stated=False)
        if not after.kept[loop]:
            continue
        others = np.flatnonzero(problem.doubted & ~after.kept)
        others = others[~np.isin(others, sure)]
        if not len(others):
            continue
        found = innovations_of(problem, after, others)
        chance = found.chance(problem.limit, after.variance)
        judged = chance < chance_below
        support = np.sum(judged & (found.squared <= problem.limit * after.variance))
        if support >= least + multiple * np.sum(chance[judged]):
            return after, tried
    return state, len(hopeful)


def _accepting(problem: DoubtedGraph, state: Accepted, more: NDArray[np.int64], stated: bool) -> Accepted:
    """Accept loops, solve, and drop those that the solution contradicts, the worst first."""
    kept = state.kept.copy()
    kept[more] = True
    poses, variance, iterations = state.poses, state.variance, state.iterations
    anew = True
    while True:
        descent = solved_with(problem, kept, poses, _ON_THE_WAY, anew)
        poses, iterations, anew = descent.point.poses, iterations + descent.iterations, False
        squared = 2 * np.asarray(descent.point.edge_costs)[: len(kept)]
        loops = kept & problem.doubted
        if not stated:
            freedom = problem.size * np.sum(loops)
            variance = min(1.0, float((squared[kept].sum() + _STATED) / (freedom + _STATED)))
        largest = squared[loops].max(initial=0.0)
        if largest <= problem.limit * variance:
            return Accepted(kept, poses, variance, iterations)
        kept = kept & ~(loops & (squared > max(problem.limit * variance, _WORST * largest)))


def _first_variance(found: Innovations, problem: DoubtedGraph) -> float:
    """Return the variance of the noise, before any loop is accepted, over the stated one.

    Below the true variance right loops do not agree. Above it none but wrong ones are added, and these no
    more often than by chance. So the least variance is taken with almost the largest number of loops that
    agree, less those expected by chance.
    """
    variances = 2.0 ** -np.arange(_HALVINGS)
    excess = [
        np.sum(found.squared <= problem.limit * variance) - np.sum(found.chance(problem.limit, variance))
        for variance in variances
    ]
    enough = np.array(excess) >= _ALMOST_ALL * max(np.max(excess), 0.0)
    return float(variances[np.flatnonzero(enough)[-1]]) if np.any(enough) else 1.0
