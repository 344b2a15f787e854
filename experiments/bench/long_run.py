"""A long drive with its back end: is any scan delayed, and does memory grow more than the keyframes need?

    python experiments/bench/long_run.py [--world city] [--scans 36000] [--minutes 15] [--gps] [--json FILE]

The scans of a VLP-16 are simulated while they are tracked; after the given number of minutes the run ends. A
scan's time is that of all stages after casting: padding, step, and the transfer to the back end.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from flat_over_time import resident_mb

from lio_jax.commands.runtime import prepare_jax
from lio_jax.run.sinks import Sink

_MB = 2**20


def main() -> None:
    """Drive and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--world", default="city")
    parser.add_argument("--scans", type=int, default=36_000)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--gps", action="store_true", help="use fixes with noise besides the loops")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    prepare_jax()
    result = driven(options)
    tenths = np.array_split(np.arange(result["scans"]), 10)
    print(f"{'scans':>16}{'median ms':>11}{'longest ms':>12}{'memory MiB':>12}{'keyframes':>11}{'MiB':>11}")
    for part in tenths:
        times, last = np.array(result["scan_ms"])[part], part[-1]
        print(
            f"{part[0]:7d} -{last:7d}{np.median(times):11.2f}{times.max():12.1f}"
            f"{result['memory_mb'][last]:12.0f}{result['keyframes'][last]:11d}"
            f"{result['keyframes_mb'][last]:11.0f}"
        )
    print(f"path {result['path_m']:.0f} m, {result['loops']} loops; end: {result['end_s']:.1f} s")
    print(f"ATE {result['odometry_ate_m']:.2f} m odometry, {result['ate_m']:.2f} m corrected")
    if options.json:
        options.json.write_text(json.dumps(result) + "\n")


def driven(options: argparse.Namespace) -> dict[str, Any]:
    """Return times, memory and errors of a drive."""
    from lio_jax import GpsModel, ImuModel, SimulatedSequence
    from lio_jax.evaluation.evaluate import evaluate
    from lio_jax.run.run import run_sequence, settings_for
    from lio_jax.settings.settings import recipe_settings, with_overrides

    gps = GpsModel() if options.gps else None
    sequence = SimulatedSequence(options.world, "vlp16", 0.1 * options.scans, 0, imu=ImuModel(), gps=gps)
    wanted = ["config.backend.loops=true", f"config.backend.gps={str(options.gps).lower()}"]
    settings, _ = settings_for(sequence, with_overrides(recipe_settings("default"), wanted))
    with tempfile.TemporaryDirectory() as folder:
        store, watch = Path(folder) / "keyframes", _Watch(60 * options.minutes)
        watch.store = store
        run = run_sequence(sequence, settings, Path(folder), sinks=(watch,))
        ended = time.perf_counter()
        found = run.metrics["backend"]
    stages = zip(run.stage_ms["total"], run.stage_ms["record"], strict=False)
    times = np.array([whole + record for whole, record in stages])
    assert run.odometry is not None
    truth = sequence.truth()
    return {
        "scans": len(times),
        "scan_ms": times.tolist(),
        "memory_mb": watch.memory_mb,
        "keyframes": watch.keyframes,
        "keyframes_mb": watch.keyframes_mb,
        "end_s": ended - watch.last,
        "loops": found["loops"]["closed"],
        "path_m": evaluate(run.odometry, truth).path_length_m,
        "odometry_ate_m": evaluate(run.odometry, truth).ate.rmse,
        "ate_m": evaluate(run.trajectory, truth).ate.rmse,
    }


class _Watch(Sink):
    """Notes memory and keyframes after each scan and ends the run when its time is up."""

    def __init__(self, seconds: float) -> None:
        self.memory_mb: list[float] = []
        self.keyframes: list[int] = []
        self.keyframes_mb: list[float] = []
        self.store: Path | None = None
        self.last = time.perf_counter()
        self._until = self.last + seconds

    def take(self, result: Any) -> None:
        self.memory_mb.append(resident_mb())
        if len(self.memory_mb) % 100 == 1:
            files = list(self.store.glob("*.npz")) if self.store else []
            self._held = len(files), sum(file.stat().st_size for file in files) / _MB
        self.keyframes.append(self._held[0])
        self.keyframes_mb.append(self._held[1])
        self.last = time.perf_counter()
        if self.last > self._until:
            raise KeyboardInterrupt


if __name__ == "__main__":
    main()
