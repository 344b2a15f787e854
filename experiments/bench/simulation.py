"""How fast are recordings simulated, and does memory stay constant?

    python experiments/bench/simulation.py [--world city] [--sensors vlp16 hdl64] [--scans 50] [--hour]
        [--json]

Every sensor runs in a process of its own, which gives its peak memory. With --hour the recording is an hour
long, with its IMU samples, truth and GPS in memory, and its scans are taken from all parts of it.
"""

import argparse
import json
import resource
import subprocess
import sys
import time

import numpy as np


def measured(world: str, sensor: str, scans: int, hour: bool) -> dict[str, float | str]:
    """Simulate in this process and return times and memory."""
    from lio_jax.sim.gps import GpsModel
    from lio_jax.sim.imu import ImuModel
    from lio_jax.sim.sequence import SimulatedSequence

    duration = 3600.0 if hour else 0.1 * (scans + 20)
    began = time.perf_counter()
    sequence = SimulatedSequence(world, sensor, duration, imu=ImuModel(), gps=GpsModel())
    opened = time.perf_counter()
    # held in memory while scans are cast, as a program that writes a recording does
    held = (sequence.imu(), sequence.truth(), sequence.gps(), sequence.truth_arrays())
    ready = time.perf_counter()
    next(sequence.scans())
    compiled = time.perf_counter()
    numbers = np.linspace(1, sequence.info.scan_count - 1, scans).astype(int)
    memory, points = [], 0
    began_scans, cpu = time.perf_counter(), time.process_time()
    for number in numbers:
        points += len(next(sequence.scans(int(number), 1)).points)
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    wall, cpu = time.perf_counter() - began_scans, time.process_time() - cpu
    return {
        "world": world,
        "sensor": sensor,
        "duration_s": sequence.duration_s,
        "scans_per_s": scans / wall,
        "cpu_ms_per_scan": 1000 * cpu / scans,
        "points_per_scan": points / scans,
        "open_s": opened - began,
        "imu_gps_truth_s": ready - opened,
        "first_scan_s": compiled - ready,
        "early_mb": memory[len(memory) // 10],
        "peak_mb": memory[-1],
        "truth_poses": len(held[1]),
    }


def main() -> None:
    """Measure each sensor and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world", default="city")
    parser.add_argument("--sensors", nargs="+", default=["vlp16", "hdl64"])
    parser.add_argument("--scans", type=int, default=50)
    parser.add_argument("--hour", action="store_true", help="an hour's recording, sampled all over")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.alone:
        print(json.dumps(measured(options.world, options.sensors[0], options.scans, options.hour)))
        return
    rows = []
    print(
        f"{'world':8}{'sensor':10}{'scans/s':>9}{'cpu ms':>8}{'points':>9}{'open s':>8}{'imu.. s':>8}"
        f"{'1st s':>7}{'early MiB':>11}{'peak MiB':>10}"
    )
    for sensor in options.sensors:
        words = ["--world", options.world, "--sensors", sensor, "--scans", str(options.scans), "--alone"]
        words += ["--hour"] * options.hour
        command = [sys.executable, __file__, *words]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        row = json.loads(done.stdout.splitlines()[-1])
        rows.append(row)
        print(
            f"{row['world']:8}{row['sensor']:10}{row['scans_per_s']:9.1f}{row['cpu_ms_per_scan']:8.0f}"
            f"{row['points_per_scan']:9.0f}{row['open_s']:8.1f}{row['imu_gps_truth_s']:8.1f}"
            f"{row['first_scan_s']:7.1f}{row['early_mb']:11.0f}{row['peak_mb']:10.0f}",
            flush=True,
        )
    if options.json:
        print(json.dumps({"rows": rows}))


if __name__ == "__main__":
    main()
