"""Costs of a run besides its scans: cold and warm compilation, the whole command, peak memory.

    python experiments/bench/startup.py RECORDING [--scans 60] [--runs 3] [--json]

Each run is a separate process; the first starts with an empty compilation cache.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np


def timed_run(recording: Path, scans: int, work: Path, name: str) -> dict[str, Any]:
    """Run the command line once and return times and memory."""
    out = work / name
    command = [sys.executable, "-m", "lio_jax.cli", "run", str(recording), "--out", str(out)]
    environment = os.environ | {"LIO_JAX_CACHE": str(work / "cache")}
    start = time.perf_counter()
    subprocess.run(
        [*command, "--scans", str(scans)], env=environment, check=True, capture_output=True, text=True
    )
    command_s = time.perf_counter() - start
    metrics = json.loads((out / "metrics.json").read_text())
    return {
        "scans": metrics["scans"],
        "compile_s": metrics["compile_s"],
        "command_s": command_s,
        "peak_rss_mb": metrics["peak_rss_mb"],
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--scans", type=int, default=60)
    parser.add_argument("--runs", type=int, default=3, help="with a warm cache, after the cold one")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        cold = timed_run(options.recording, options.scans, work, "cold")
        warm_runs = [
            timed_run(options.recording, options.scans, work, f"warm{run}") for run in range(options.runs)
        ]
    warm = {key: float(np.median([run[key] for run in warm_runs])) for key in cold}
    print(f"{'cache':6}{'scans':>7}{'compile s':>11}{'command s':>11}{'peak MiB':>10}")
    for name, row in (("cold", cold), ("warm", warm)):
        figures = f"{row['compile_s']:11.2f}{row['command_s']:11.2f}{row['peak_rss_mb']:10.0f}"
        print(f"{name:6}{row['scans']:7.0f}{figures}")
    if options.json:
        print(json.dumps({"cold": cold, "warm": warm}))


if __name__ == "__main__":
    main()
