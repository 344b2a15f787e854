"""Does the time per scan or the memory grow over a long drive? Compares its first tenth with its last.

    python experiments/bench/flat_over_time.py [--scans 2000] [--json]

The scans are simulated while they are tracked, so only the estimator itself can accumulate memory.
"""

import argparse
import json
import os
from pathlib import Path

import jax
import numpy as np

from lio_jax.run.track import track
from lio_jax.settings.settings import Settings, with_extrinsics
from lio_jax.sim.sequence import SimulatedSequence


def resident_mb() -> float:
    """Return the process's resident memory, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    """Track a simulated street and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scans", type=int, default=2000)
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)

    sequence = SimulatedSequence(world="street", duration_s=0.1 * options.scans)
    settings = with_extrinsics(Settings(), sequence.info.T_imu_lidar, "simulation")
    scan_ms, iterations, memory_mb, estimate, stamps = [], [], [], [], []
    for tracked in track(settings, sequence.scans()):
        scan_ms.append(tracked.stage_ms["total"])
        iterations.append(int(tracked.output.registration.iterations))
        memory_mb.append(resident_mb())
        estimate.append(tracked.T_world_imu[:3, 3])
        stamps.append(tracked.stamp_ns)
    tenth = max(1, len(scan_ms) // 10)
    result = {
        "scans": len(scan_ms),
        "first_tenth_ms": float(np.median(scan_ms[:tenth])),
        "last_tenth_ms": float(np.median(scan_ms[-tenth:])),
        "first_tenth_iterations": float(np.mean(iterations[:tenth])),
        "last_tenth_iterations": float(np.mean(iterations[-tenth:])),
        "first_tenth_mb": float(np.median(memory_mb[:tenth])),
        "last_tenth_mb": float(np.median(memory_mb[-tenth:])),
    }
    result["time_ratio"] = result["last_tenth_ms"] / result["first_tenth_ms"]
    result["memory_ratio"] = result["last_tenth_mb"] / result["first_tenth_mb"]
    truth = sequence.truth().at(np.array(stamps)).positions
    result["end_error_m"] = float(np.linalg.norm(estimate[-1] - truth[-1]))
    result["path_length_m"] = float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    print(
        f"{result['scans']} scans, {result['path_length_m']:.0f} m, end error {result['end_error_m']:.2f} m"
    )
    print(f"{'':20}{'first tenth':>12}{'last tenth':>12}{'ratio':>8}")
    for name, unit in (("time", "ms"), ("solve", "iterations"), ("memory", "mb")):
        first, last = result[f"first_tenth_{unit}"], result[f"last_tenth_{unit}"]
        print(f"{name + ' [' + unit + ']':20}{first:12.2f}{last:12.2f}{last / first:8.3f}")
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
