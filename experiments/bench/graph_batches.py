"""Sets of edge weights of one small pose graph: a single batched program against one host solve each, s.

    python experiments/bench/graph_batches.py [--sets 64] [--poses 24] [--repeats 5]

The graph is in space, with two loops. The program is compiled before; its time is in the table. Both
use the same limits. "gradient" is that of the sum of all positions by all weights.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", type=int, default=64)
    parser.add_argument("--poses", type=int, default=24)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import jaxlie

    from lio_jax.pose_graph.pose_derivative import solved_poses
    from tests.loops.graphs import graph_of, walk

    rng = np.random.default_rng(0)
    loops = [(0, options.poses - 4), (options.poses // 3, options.poses - 1)]
    graph = graph_of(walk(jaxlie.SE3, options.poses, rng), loops, rng)
    logs = jnp.asarray(rng.normal(size=(options.sets, len(graph.i))))

    def solved(logs: jax.Array) -> jax.Array:
        information = graph.information * jnp.exp(logs)[:, None, None]
        return solved_poses(eqx.tree_at(lambda g: g.information, graph, information)).translation()

    gradient = jax.grad(lambda logs: jnp.sum(solved(logs)))
    print(f"{'':10}{'compile':>9}{'batch':>16}{'one by one':>16}")
    for name, function in {"solution": solved, "gradient": gradient}.items():
        batched = jax.jit(jax.vmap(function))
        compile_s, _ = _timed(partial(batched, logs))
        function(logs[0])
        runs: dict[str, Callable[[], Any]] = {
            "batch": partial(batched, logs),
            "one by one": partial(_one_by_one, function, logs),
        }
        measured = {who: [_timed(run) for _ in range(options.repeats)] for who, run in runs.items()}
        times = {who: [seconds for seconds, _ in row] for who, row in measured.items()}
        print(f"{name:10}{compile_s:9.2f}", end="")
        print("".join(f"{min(row):8.3f} /{np.median(row):6.3f}" for row in times.values()))
        apart = np.abs(measured["batch"][0][1] - measured["one by one"][0][1]).max()
        print(f"{'':10}largest difference {apart:.1e}")


def _one_by_one(function: Callable[[Any], Any], logs: Any) -> list[np.ndarray]:
    return [np.asarray(function(each)) for each in logs]


def _timed(run: Callable[[], Any]) -> tuple[float, np.ndarray]:
    begin = time.perf_counter()
    result = np.asarray(run())
    return time.perf_counter() - begin, result


if __name__ == "__main__":
    main()
