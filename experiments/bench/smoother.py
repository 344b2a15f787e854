"""Time of the smoother in float64, compared with gtsam's batch Levenberg-Marquardt on the same factors.

    python experiments/bench/smoother.py [--windows 20 100] [--lengths 500 1000 2000 4000 8000] [--repeats 5]
        [--json]

"update" adds a state to a full window: the oldest state is marginalised, the rest is smoothed again.
"iteration" is one linearisation and solve of a whole recording, "solve" a whole solve from a guess with
errors of 0.05 rad, 0.05 m and 0.05 m/s; gtsam gets the same factors and guess with its default settings. Both
take turns.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import gtsam  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from gtsam_chain import GtsamChain  # noqa: E402
from simulated_chain import GRAVITY, Recording, rows, simulate  # noqa: E402

from lio_jax.estimation.sliding_window import Added, append_and_update, open_window  # noqa: E402
from lio_jax.estimation.smoother import smooth  # noqa: E402

TOLERANCE = 1e-3
"""Tolerance of a solve, in standard deviations."""


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--windows", type=int, nargs="*", default=[20, 100])
    parser.add_argument("--lengths", type=int, nargs="*", default=[500, 1000, 2000, 4000, 8000])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    windows = []
    print(f"{'window':>8}{'update ms':>12}{'p95 ms':>9}{'iterations':>12}")
    for capacity in options.windows:
        windows.append(window_figures(capacity))
        print("{capacity:8d}{update_ms:12.2f}{update_p95_ms:9.2f}{iterations:12.1f}".format(**windows[-1]))
    lengths = []
    print(
        f"\n{'states':>8}{'iteration ms':>14}{'us a state':>12}{'solve ms':>10}{'gtsam ms':>10}{'ratio':>8}"
    )
    for length in options.lengths:
        row = batch_figures(length, options.repeats)
        lengths.append(row)
        print(
            "{states:8d}{iteration_ms:14.1f}{us_per_state:12.1f}{solve_ms:10.1f}{gtsam_ms:10.1f}"
            "{ratio:8.2f}".format(**row),
            flush=True,
        )
    if options.json:
        print(json.dumps({"windows": windows, "lengths": lengths}))


def window_figures(capacity: int) -> dict[str, float]:
    """Return the time of updates after the window is full."""
    recording = simulate(0, capacity + 41)
    chain = recording.chain
    advance = jax.jit(partial(append_and_update, max_iterations=10, tolerance=jnp.array(TOLERANCE)))
    window = open_window(capacity, chain.prior, GRAVITY, Added(rows(chain.imu, 0), rows(chain.lidar, 0)))
    spent, iterations = [], []
    for k in range(1, capacity + 41):
        added = jax.block_until_ready(Added(rows(chain.imu, k - 1), rows(chain.lidar, k)))
        milliseconds, (window, result) = timed(lambda added=added, window=window: advance(window, added))
        if k > capacity:
            spent.append(milliseconds)
            iterations.append(int(result.iterations))
    return {
        "capacity": capacity,
        "update_ms": float(np.median(spent)),
        "update_p95_ms": float(np.percentile(spent, 95)),
        "iterations": float(np.mean(iterations)),
    }


def batch_figures(length: int, repeats: int) -> dict[str, float]:
    """Return the times of one iteration and of a solve, and the times of gtsam."""
    recording = off_by(simulate(0, length), 0.05)
    theirs = GtsamChain(recording)
    graph, values = theirs.graph(), theirs.values()
    program = jax.jit(
        lambda chain, guess, n: smooth(chain, guess, max_iterations=n, tolerance=jnp.array(TOLERANCE))
    )

    def ours(bound: int) -> Any:
        return program(recording.chain, recording.guess, jnp.int32(bound))

    solved = jax.block_until_ready(ours(50))
    jax.block_until_ready(ours(1))
    spent: dict[str, list[float]] = {"one": [], "solve": [], "gtsam": []}
    for _ in range(repeats):
        spent["one"].append(timed(lambda: ours(1))[0])
        spent["solve"].append(timed(lambda: ours(50))[0])
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams())
        spent["gtsam"].append(timed(optimiser.optimize)[0])
    one, solve, peer = (float(np.median(spent[name])) for name in ("one", "solve", "gtsam"))
    # work that is done once, for example the links' information, is in a solve but not in an iteration
    iteration = (solve - one) / (int(solved.iterations) - 1)
    return {
        "states": length,
        "iteration_ms": iteration,
        "us_per_state": 1e3 * iteration / length,
        "solve_ms": solve,
        "iterations": int(solved.iterations),
        "cost": float(solved.normal.cost),
        "gtsam_ms": peer,
        "gtsam_iterations": int(optimiser.iterations()),
        "gtsam_cost": float(optimiser.error()),
        "ratio": solve / peer,
    }


def off_by(recording: Recording, sigma: float) -> Recording:
    """Return the recording with a guess near the truth; dead reckoning would be far away from it."""
    shape = (*recording.truth.velocity.shape[:1], 15)
    error = sigma * jax.random.normal(jax.random.key(1), shape) * (jnp.arange(15) < 9)
    return dataclasses.replace(recording, guess=recording.truth.retract(error))


def timed(program: Callable[[], Any]) -> tuple[float, Any]:
    """Return the time (ms) and the result."""
    begin = time.perf_counter()
    result = program()
    if not isinstance(result, gtsam.Values):
        jax.block_until_ready(result)
    return 1e3 * (time.perf_counter() - begin), result


if __name__ == "__main__":
    main()
