"""``lio-jax optimize-graph``: solve a pose graph in a g2o file."""

import json
import math
import time
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np

from lio_jax.commands.runtime import say
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.pose_graph.chordal import chordal_poses
from lio_jax.pose_graph.g2o import G2oFile, read_g2o, write_graph
from lio_jax.pose_graph.graph import LOOP, Solution
from lio_jax.pose_graph.multifrontal import NotPositiveDefiniteError
from lio_jax.pose_graph.pose_graph import compile_for, solve
from lio_jax.pose_graph.robust import Robust
from lio_jax.pose_graph.structure import structure_of

_NAMED = 5
"""Number of distrusted edges that are named."""


def optimize_graph(source: Path, out: Path, robust: bool, as_json: bool) -> None:
    """Solve the graph, write it with the solution's poses, and print cost and time.

    Raises:
        UsageError: the result would replace the input, or has no folder to go to.
        LioJaxError: the file is no pose graph, or its numbers have no solution.
    """
    if out.exists() and source.exists() and out.samefile(source):
        raise UsageError(f"{out}: the result would replace the input; choose another name.")
    if out.is_dir() or not out.parent.is_dir():
        raise UsageError(f"{out}: not a file in a folder that exists; choose another path.")
    file = read_g2o(source)
    for note in file.notes:
        say(f"note: {source}: {note}")
    try:
        solution, file, compile_s, solve_s = _solved(file, robust)
    except NotPositiveDefiniteError:
        raise LioJaxError(
            f"{source}: its equations have no solution; some weight is far too large or too small."
        ) from None
    graph = file.graph
    if solution.status == "not finite":
        raise LioJaxError(f"{source}: the cost is not a finite number; some edge or weight is far too large.")
    if solution.status != "converged":
        say(f"warning: {source}: not converged ({solution.status}); the poses are the best ones found.")
    if robust:
        say(_distrusted(file, solution))
    write_graph(out, eqx.tree_at(lambda graph: graph.poses, graph, solution.poses), file.ids)
    initial = float(solution.initial_cost)
    result = {
        # a vertex at 1e200 m has a cost beyond any number, and the solution need not
        "initial_cost": initial if math.isfinite(initial) else None,
        "final_cost": float(solution.cost),
        "iterations": solution.iterations,
        "status": solution.status,
        "solve_s": solve_s,
    }
    if as_json:
        print(json.dumps(result, allow_nan=False))
        return
    loops = int(np.sum(np.asarray(graph.kind) == LOOP))
    print(f"graph       {len(file.ids)} vertices, {len(graph.i)} edges, {loops} of them loops")
    before = f"{initial:.7g}" if math.isfinite(initial) else "not finite"
    print(f"cost        {before} -> {result['final_cost']:.7g}")
    print(f"iterations  {solution.iterations} ({solution.status})")
    print(f"time        {solve_s:.3f} s, and {compile_s:.3f} s to compile")
    print(f"written     {out}")


def _solved(file: G2oFile, robust: bool) -> tuple[Solution, G2oFile, float, float]:
    """Return the solution, the graph with its first guess, and the times to compile and to solve, s."""
    graph = file.graph
    if not file.has_poses:
        graph = eqx.tree_at(lambda graph: graph.poses, graph, chordal_poses(graph, structure_of(graph)))
        file = replace(file, graph=graph)
    begin = time.perf_counter()
    compile_for(graph)
    compiled = time.perf_counter()
    solution = solve(graph, robust=Robust() if robust else None)
    return solution, file, compiled - begin, time.perf_counter() - compiled


def _distrusted(file: G2oFile, solution: Solution) -> str:
    graph = file.graph
    wrong = np.flatnonzero(np.asarray(solution.weights) < 0.5)
    loops = int(np.sum(np.asarray(graph.kind) == LOOP))
    if not len(wrong):
        return f"note: none of {loops} loops contradicts the rest."
    ends = zip(file.ids[np.asarray(graph.i)[wrong]], file.ids[np.asarray(graph.j)[wrong]], strict=True)
    named = ", ".join(f"{i}-{j}" for i, j in list(ends)[:_NAMED])
    return f"note: {len(wrong)} of {loops} loops distrusted: {named}{', ...' if len(wrong) > _NAMED else ''}."
