"""Pose graphs with wrong loops: how many are kept, how many right ones rejected, and how long it takes.

    python experiments/bench/wrong_loops.py [--only NAME ...] [--share 0.5] [--seeds 0 1]

Wrong loops are added until they are the given share of all loops. Each takes the measurement of a right loop
and puts it between two other vertices ("copied"), or does so for five neighbours at once ("grouped"), or
measures a random relative pose ("random"). A loop counts as wrong if the poses of the graph without wrong
loops contradict it at 99 %: a few of those drawn agree by chance. Recorded graphs are added if the recordings
are next to the checkout.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

if TYPE_CHECKING:
    from lio_jax.pose_graph.graph import PoseGraph

KINDS = ("copied", "grouped", "random")
RECORDED = ("sphere2500", "parking-garage", "M3500", "intel", "MIT")
_GROUP = 5


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="graphs; all without it")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--share", type=float, default=0.5, help="wrong loops among all loops")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    options = parser.parse_args()
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    print(f"{'graph':16}{'wrong loops':>22}{'seed':>6}{'time, s':>9}{'wrong kept':>16}{'right rejected':>18}")
    for name, clean in _graphs(options.only).items():
        for kind in options.kinds:
            for seed in options.seeds:
                print(_row(name, clean, kind, options.share, seed), flush=True)


def _graphs(only: list[str]) -> "dict[str, PoseGraph]":
    from experiments.bench import pose_graph

    graphs = {}
    for name in RECORDED:
        path = pose_graph.RECORDINGS / f"{name}.g2o"
        if path.is_file() and (not only or name in only):
            graphs[name] = pose_graph.read(path)
    makers = {"torus5000": pose_graph.torus, "chain4500": pose_graph.chain}
    return graphs | {name: make() for name, make in makers.items() if not only or name in only}


def _row(name: str, clean: "PoseGraph", kind: str, share: float, seed: int) -> str:
    import equinox as eqx
    from scipy.stats import chi2

    from lio_jax.pose_graph.factors import edge_costs
    from lio_jax.pose_graph.graph import LOOP
    from lio_jax.pose_graph.pose_graph import compile_for, solve
    from lio_jax.pose_graph.robust import Robust

    graph = spoilt(clean, kind, share, np.random.default_rng(seed))
    at_truth = eqx.tree_at(lambda graph: graph.poses, graph, solve(clean).poses)
    limit = chi2.ppf(Robust.confidence, graph.information.shape[-1])
    wrong = 2 * np.asarray(edge_costs(at_truth.poses, at_truth)) > limit
    compile_for(graph)
    begin = time.perf_counter()
    kept = np.asarray(solve(graph, robust=Robust()).weights) > 0.5
    seconds = time.perf_counter() - begin
    right = (np.asarray(graph.kind) == LOOP) & ~wrong
    of_wrong, of_right = (
        f"{np.sum(kept & wrong)} of {np.sum(wrong)}",
        f"{np.sum(~kept & right)} of {np.sum(right)}",
    )
    return f"{name:16}{f'{100 * share:.0f} % {kind}':>22}{seed:6d}{seconds:9.1f}{of_wrong:>16}{of_right:>18}"


def spoilt(graph: "PoseGraph", kind: str, share: float, rng: np.random.Generator) -> "PoseGraph":
    """Return the graph with wrong loops.

    Args:
        graph: a graph whose loops are right.
        kind: one of ``KINDS``.
        share: number of wrong loops over that of all loops.
        rng: draws them.
    """
    import jax.numpy as jnp

    from lio_jax.pose_graph.graph import LOOP, numbers_of
    from tests.loops.graphs import with_edges

    loops = np.flatnonzero(np.asarray(graph.kind) == LOOP)
    vertices, count = len(graph.fixed), round(len(loops) * share / (1 - share))
    if kind == "grouped":
        first = np.repeat(rng.integers(0, vertices - _GROUP, (-(-count // _GROUP), 2)), _GROUP, 0)[:count]
        ends = first + (np.arange(count) % _GROUP)[:, None]
        source = np.repeat(rng.choice(loops, -(-count // _GROUP)), _GROUP)[:count]
    else:
        ends, source = rng.integers(0, vertices, (count, 2)), rng.choice(loops, count)
    near = np.abs(np.diff(ends)[:, 0]) < 2
    ends[near, 1] = (ends[near, 1] + vertices // 2) % vertices
    measured = numbers_of(graph.measurement)[source]
    if kind == "random":
        measured = _random_poses(numbers_of(graph.poses), count, rng)

    poses = type(graph.measurement)(jnp.asarray(measured))
    return with_edges(graph, ends.min(1), ends.max(1), poses, np.asarray(graph.information)[source], LOOP)


def _random_poses(among: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the numbers of poses with any rotation, as far from each other as those given."""
    size = 3 if among.shape[1] == 7 else 2
    turn = rng.normal(size=(count, among.shape[1] - size))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return np.concatenate([turn, rng.normal(size=(count, size)) * among[:, -size:].std(0)], 1)


if __name__ == "__main__":
    main()
