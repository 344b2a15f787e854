"""Time of many parameter sets on one recording: one ablation against separate runs.

    python experiments/bench/ablation.py [--sets 64] [--separate 8] [--seconds 3] [--batch auto] [--json]

A short simulated street (32 beams x 1024, inertial samples) is written once. The ablation is one
``lio-jax ablate`` of all sets, including its start and table. Only a few of the separate ``lio-jax run``
processes (without pictures, maps and recordings) are measured: as many at a time as there are cores, half of
them before the ablation and half after it. Their time is scaled up to the number of sets. Compiled programs
are cached for both.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import yaml

_QUIET = ("config.output.map=false", "config.output.recording=false", "config.output.plot=false")
_PATH = "params.lidar.range_sigma"


def main() -> None:
    """Measure and print the table."""
    options = _options()
    cores = len(os.sched_getaffinity(0))
    sets = np.geomspace(0.02, 0.1, options.sets).tolist()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        os.environ["LIO_JAX_CACHE"] = str(work / "cache")
        data = work / "street"
        _lio_jax(
            *("sim", "street", "--sensor", "generic32", "--seed", "1"),
            *("--duration", str(options.seconds), "--out", str(data)),
        )
        # fill the cache of compiled programs
        _separate(data, sets[:1], work / "warm", cores)
        _ablation(data, sets[:2], work, "warm_ablation", options.batch)
        half = max(1, options.separate // 2)
        spent = _separate(data, sets[:half], work / "before", cores)
        together_s = _ablation(data, sets, work, "ablation", options.batch)
        spent += _separate(data, sets[half : 2 * half], work / "after", cores)
    separate_s = spent * options.sets / (2 * half)
    report = {
        "sets": options.sets,
        "cores": cores,
        "batch": options.batch,
        "ablation_s": together_s,
        "separate_s": separate_s,
        "separate_measured": 2 * half,
        "share": together_s / separate_s,
        "factor": separate_s / together_s,
    }
    print(f"{'parameter sets':>15}{'ablation s':>12}{'separate s':>12}{'share':>8}{'factor':>8}")
    print(
        f"{options.sets:15d}{together_s:12.1f}{separate_s:12.1f}{report['share']:8.2f}{report['factor']:8.1f}"
    )
    print(f"{2 * half} separate runs were measured, {cores} at a time, and scaled up.")
    if options.json:
        print(json.dumps(report))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", type=int, default=64)
    parser.add_argument("--separate", type=int, default=8, help="separate runs to measure")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of the recording")
    parser.add_argument("--batch", default="auto", help="parameter sets in one program")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


def _separate(data: Path, sets: list[float], out: Path, at_once: int) -> float:
    """Return the time of one run for each set, s."""

    def one(number: int) -> None:
        words = ("--out", str(out / str(number)), "--set", f"{_PATH}={sets[number]}", *_QUIET)
        _lio_jax("run", str(data), *words)

    start = time.perf_counter()
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(one, range(len(sets))))
    return time.perf_counter() - start


def _ablation(data: Path, sets: list[float], work: Path, name: str, batch: str) -> float:
    """Return the time of the ablation of all sets, s."""
    tree = {
        "sequences": [{"path": str(data)}],
        "grid": {_PATH: sets},
        "batch": int(batch) if batch.isdigit() else batch,
    }
    spec = work / f"{name}.yaml"
    spec.write_text(yaml.safe_dump(tree))
    start = time.perf_counter()
    _lio_jax("ablate", str(spec), "--out", str(work / name))
    return time.perf_counter() - start


def _lio_jax(*words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "lio_jax.cli", *words], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"lio-jax {' '.join(words)}\n{done.stderr}")


if __name__ == "__main__":
    main()
