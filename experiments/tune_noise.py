"""Recover known noise without ground truth, and check the result on recordings that were not used for tuning.

    python experiments/tune_noise.py [--recipe default | lio_sam] [--worlds street city] [--seeds 0 1 2]
        [--held-out 100 101 102] [--seconds 20] [--factors 10 0.1] [--objectives noise] [--iterations 40]
        [--surface] [--simplex] [--json FILE]

Simulates recordings of a MEMS sensor, starts with all noise FACTOR times its true value, and tunes on each
recording alone: the recipe default by its innovations, lio_sam by its smoother's marginal likelihood. The
tables show the ratio of found to true values; consistency and trajectory error of the tuned recipe on the
held-out recordings; and, with --simplex, the loss over the scans processed, also for Nelder & Mead's method.
All worlds run with the first world's voxel sizes.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from known_noise import BLOCKS, SURFACE, TRUE, TUNINGS, Found, Workshop

from lio_jax.commands.runtime import prepare_jax


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--recipe", choices=TUNINGS, default="default")
    parser.add_argument("--worlds", nargs="+", default=["street", "city"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--held-out", nargs="*", type=int, default=[100, 101, 102])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--factors", nargs="+", type=float, default=[10.0, 0.1])
    parser.add_argument("--objectives", nargs="+")
    parser.add_argument("--iterations", type=int, default=40)
    parser.add_argument("--surface", action="store_true", help=f"tune {SURFACE} too (default)")
    parser.add_argument("--simplex", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    options.objectives = options.objectives or [TUNINGS[options.recipe].objective]
    prepare_jax()
    jax.config.update("jax_enable_x64", True)
    report = {objective: tables(objective, options) for objective in options.objectives}
    if options.json:
        options.json.write_text(json.dumps(report, indent=1) + "\n")


def tables(objective: str, options: argparse.Namespace) -> dict[str, Any]:
    """Tune, check and print for one objective."""
    shop = Workshop(options.recipe, options.seconds, objective, options.worlds[0], options.surface)
    names = [name.split(".")[1] for name in shop.free.names]
    true = np.array([np.log(TRUE.get(name, 1.0)) for name in shop.free.names])
    print(f"\nobjective {objective}: found / true [95 % interval]; what has no true value as it is")
    print(f"{'world':8}{'seed':>5}{'start':>7}" + "".join(f"{name:>28}" for name in names) + f"{'s':>7}")
    found: list[Found] = []
    rows: list[dict[str, Any]] = []
    for world in options.worlds:
        for seed in options.seeds:
            for factor in options.factors:
                began = time.perf_counter()
                one = shop.tuned(world, seed, factor, options.iterations)
                # the interval of a walk that is not observable has no upper end
                with np.errstate(over="ignore"):
                    low, middle, high = (np.exp(one.x - true + k * one.sigma) for k in (-1.96, 0, 1.96))
                cells = (f"{m:.3g} [{a:.2g}, {b:.2g}]" for a, m, b in zip(low, middle, high, strict=True))
                line = "".join(f"{cell:>28}" for cell in cells)
                print(f"{world:8}{seed:5d}{factor:7g}{line}{time.perf_counter() - began:7.0f}", flush=True)
                found.append(one)
                rows.append({"world": world, "seed": seed, "factor": factor, "ratio": middle.tolist()})
    judged = judgement(shop, found, options)
    course = comparison(shop, found[0], options) if options.simplex else None
    return {"names": names, "recovered": rows, "judged": judged, "simplex": course}


def judgement(shop: Workshop, found: list[Found], options: argparse.Namespace) -> dict[str, Any]:
    """Run all results on the held-out recordings, and print their consistency and their errors."""
    middle = np.median([one.x for one in found], axis=0)
    settings: dict[str, np.ndarray | None] = {
        f"{factor:g} x": shop.start(factor) for factor in options.factors
    }
    settings |= {"shipped": None, "tuned": middle}
    print("\nheld-out recordings: NEES and NIS per degree of freedom (1 is consistent), ATE in mm")
    print(f"{'':10}{'world':8}{'seed':>5}" + "".join(f"{name:>10}" for name in (*BLOCKS, "NIS", "ATE")))
    results: dict[str, Any] = {}
    for name, x in settings.items():
        for world in options.worlds:
            for seed in options.held_out:
                one = shop.judged(x, world, seed)
                figures = (*one.nees.values(), one.nis, one.ate_mm)
                print(f"{name:10}{world:8}{seed:5d}" + "".join(f"{v:10.3g}" for v in figures), flush=True)
                results[f"{name} {world} {seed}"] = figures
    return results


def comparison(shop: Workshop, scored: Found, options: argparse.Namespace) -> list[tuple[int, float]]:
    """Print the losses of scoring and of Nelder & Mead's method over the scans that they processed."""
    world, seed, factor = options.worlds[0], options.seeds[0], options.factors[0]
    course = shop.simplex(world, seed, factor, scored.scans)
    length = len(shop.recording(world, seed)[0])
    print(f"\nbest loss by scans processed, {world} {seed} from {factor:g} x")
    print(f"{'scans':>8}{'scoring':>12}{'simplex':>12}")
    for place, loss in enumerate(np.minimum.accumulate(scored.losses)):
        nearest = course[min(place, len(course) - 1)][1]
        print(f"{(place + 1) * length:8d}{loss:12.4f}{nearest:12.4f}")
    return course


if __name__ == "__main__":
    main()
