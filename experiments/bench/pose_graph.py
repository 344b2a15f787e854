"""Pose graphs against gtsam: time from edges alone to the optimum, s.

    python experiments/bench/pose_graph.py [--repeats 5] [--only NAME ...] [--json]

Both compute their own initial guess (chordal) and optimise from it, gtsam by its Levenberg-Marquardt with
default settings; both have the graph in memory. They take turns in one process; the table gives the least
time and the median. Programs are compiled before. "odometry" is gtsam from the guess that neighbours' edges
give, or from the file's own guess. Recorded graphs are added if the recordings are next to the checkout.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

if TYPE_CHECKING:
    from lio_jax.pose_graph.graph import PoseGraph

_SYSTEMS = ("ours", "gtsam", "odometry")
RECORDED = ("sphere2500", "parking-garage")
RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "g2o"


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="graphs; all without it")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    rows = []
    print(
        f"{'graph':16}{'vertices':>9}{'edges':>7}{'compile':>9}{'ours':>16}{'gtsam':>16}{'ratio':>7}{'odometry':>16}"
    )
    for name, make in _graphs().items():
        if options.only and name not in options.only:
            continue
        row = _measured(name, make(), options.repeats)
        rows.append(row)
        times = {
            who: f"{row[f'{who}_s']:8.3f} /{row[f'{who}_median_s']:6.3f}"
            for who in ("ours", "gtsam", "odometry")
        }
        print(f"{name:16}{row['vertices']:9d}{row['edges']:7d}{row['compile_s']:9.2f}", end="")
        print(f"{times['ours']}{times['gtsam']}{row['ratio']:7.2f}{times['odometry']}")
        print(f"{'':16}cost " + ", ".join(f"{who} {row[f'{who}_cost']:.6f}" for who in _SYSTEMS))
    if options.json:
        print(json.dumps({"repeats": options.repeats, "rows": rows}))


def _graphs() -> "dict[str, Callable[[], PoseGraph]]":
    graphs: dict[str, Callable[[], PoseGraph]] = {}
    for name in RECORDED:
        path = RECORDINGS / f"{name}.g2o"
        if path.is_file():
            graphs[name] = lambda path=path: read(path)
    return graphs | {"torus5000": torus, "chain4500": chain}


def read(path: Path) -> "PoseGraph":
    """Read a g2o file; its first vertex is fixed."""
    import equinox as eqx
    import jax.numpy as jnp

    from lio_jax.pose_graph.g2o import read_g2o

    graph = read_g2o(path).graph
    return eqx.tree_at(lambda graph: graph.fixed, graph, jnp.arange(len(graph.fixed)) == 0)


def torus() -> "PoseGraph":
    """Return 5,000 poses that wind around a torus, each joined to its neighbour in the previous winding."""
    around, across = 100, 50
    count = around * across
    number = np.arange(count)
    along, about = 2 * np.pi * number / count, 2 * np.pi * number / across
    ring = 10 + 4 * np.cos(about)
    t = np.stack([ring * np.cos(along), ring * np.sin(along), 4 * np.sin(about)], -1)
    pairs = np.concatenate([_chain_pairs(count), np.stack([number[:-across], number[across:]], -1)])
    return _simulated(t, pairs, np.array([0.02] * 3 + [0.05] * 3))


def chain() -> "PoseGraph":
    """Return 4,500 keyframes, 1 m apart, of laps through a town, with 100 loops between the laps."""
    count, rounds = 4500, 9
    phase = 2 * np.pi * rounds * np.arange(count) / count
    t = np.stack([100 * np.cos(phase), 60 * np.sin(2 * phase), 3 * np.sin(phase / 5)], -1)
    rng = np.random.default_rng(1)
    first = rng.integers(0, count * 7 // 9, 100)
    second = first + count // rounds * rng.integers(1, 3, 100) + rng.integers(-3, 4, 100)
    pairs = np.concatenate([_chain_pairs(count), np.stack([first, second], -1)])
    return _simulated(t, pairs, np.array([0.002] * 3 + [0.02] * 3))


def _chain_pairs(count: int) -> np.ndarray:
    return np.stack([np.arange(count - 1), np.arange(1, count)], -1)


def _simulated(translations: np.ndarray, pairs: np.ndarray, sigma: np.ndarray) -> "PoseGraph":
    """Return the graph of noisy relative poses (rotation sigmas first) between poses that look ahead."""
    import jax
    import jax.numpy as jnp
    import jaxlie
    from scipy.spatial.transform import Rotation

    from lio_jax.pose_graph.graph import LOOP, ODOMETRY, PoseGraph, moved, picked, poses_from

    ahead = np.gradient(translations, axis=0)
    yaw, pitch = np.arctan2(ahead[:, 1], ahead[:, 0]), -np.arcsin(ahead[:, 2] / np.linalg.norm(ahead, axis=1))
    rotations = Rotation.from_euler("ZYX", np.stack([yaw, pitch, 0 * yaw], -1)).as_matrix()
    truth = poses_from(rotations, translations)
    noise = np.random.default_rng(0).normal(size=(len(pairs), 6)) * sigma
    exact = picked(truth, jnp.asarray(pairs[:, 0])).inverse() @ picked(truth, jnp.asarray(pairs[:, 1]))
    measurement = moved(exact, jnp.asarray(noise))
    chain = picked(measurement, jnp.arange(len(translations) - 1))
    first = picked(truth, jnp.arange(1))
    steps = jaxlie.SE3(jnp.concatenate([first.wxyz_xyz, chain.wxyz_xyz]))
    odometry = jax.lax.associative_scan(lambda a, b: a @ b, steps)
    return PoseGraph(
        odometry,
        jnp.asarray(pairs[:, 0]),
        jnp.asarray(pairs[:, 1]),
        measurement,
        jnp.asarray(np.tile(np.diag(sigma**-2.0), (len(pairs), 1, 1))),
        jnp.asarray(np.where(np.diff(pairs)[:, 0] == 1, ODOMETRY, LOOP)),
        jnp.asarray(np.arange(len(translations)) == 0),
    )


def _measured(name: str, graph: "PoseGraph", repeats: int) -> dict[str, Any]:
    import gtsam

    from lio_jax.pose_graph.pose_graph import compile_for, solve
    from tests.loops.graphs import gtsam_graph, gtsam_values

    begin = time.perf_counter()
    compile_for(graph)
    compile_s = time.perf_counter() - begin
    factors, guess = gtsam_graph(graph), gtsam_values(graph.poses)
    # its chordal initialisation has no equality constraint, and moves the first vertex slightly
    anchored = gtsam.NonlinearFactorGraph(factors)
    anchored.remove(factors.size() - 1)
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)
    anchored.push_back(gtsam.PriorFactorPose3(0, guess.atPose3(0), tight))

    def descended(start: "gtsam.Values") -> float:
        params = gtsam.LevenbergMarquardtParams()
        return anchored.error(gtsam.LevenbergMarquardtOptimizer(anchored, start, params).optimize())

    systems: dict[str, Callable[[], float]] = {
        "ours": lambda: float(solve(graph).cost),
        "gtsam": lambda: descended(gtsam.InitializePose3.initialize(anchored)),
        "odometry": lambda: descended(guess),
    }
    costs, spent = {}, {who: [] for who in systems}
    for turn in range(repeats):
        for who in np.roll(list(systems), turn).tolist():
            begin = time.perf_counter()
            costs[who] = systems[who]()
            spent[who].append(time.perf_counter() - begin)
    row: dict[str, Any] = {
        "graph": name,
        "vertices": len(graph.fixed),
        "edges": len(graph.i),
        "compile_s": compile_s,
    }
    for who, seconds in spent.items():
        row |= {
            f"{who}_s": min(seconds),
            f"{who}_median_s": float(np.median(seconds)),
            f"{who}_cost": costs[who],
        }
    return row | {"ratio": row["ours_s"] / row["gtsam_s"]}


if __name__ == "__main__":
    main()
