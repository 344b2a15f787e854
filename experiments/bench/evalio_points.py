"""Time to read the points of evalio's measurements: one by one, copied from memory, and as a whole scan.

    python experiments/bench/evalio_points.py [--repeats 20] [--json]

Each measurement has the size of a sensor and a return for all but a tenth of its firings. "positions and
times" are evalio's own two accessors for a whole cloud, which leave out the rows. "copied" is checked against
the accessors before it is timed. Times are the medians, ms.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from evalio.types import LidarMeasurement

SENSORS = ("generic16", "generic32", "os1_64", "os1_128")


def main() -> None:
    """Measure and print the table."""
    options = _options()
    rows = []
    for sensor in SENSORS:
        measurement = _measurement(sensor)
        row: dict[str, Any] = {"sensor": sensor, "points": len(measurement.points)}
        for name, read in _ways(measurement).items():
            row[name] = _median_ms(read, options.repeats)
        rows.append(row)
    if options.json:
        print(json.dumps(rows))
        return
    names = list(rows[0])
    print("| " + " | ".join(names) + " |")
    print("| " + " | ".join("---" for _ in names) + " |")
    for row in rows:
        cells = [f"{value:.2f}" if isinstance(value, float) else str(value) for value in row.values()]
        print("| " + " | ".join(cells) + " |")


def _ways(measurement: "LidarMeasurement") -> dict[str, Callable[[], Any]]:
    from lio_jax.data.evalio_points import points_can_be_copied, points_of, points_one_by_one, scan_of

    if not points_can_be_copied(measurement):
        raise SystemExit("this version of evalio keeps its points elsewhere; nothing can be copied.")
    return {
        "one by one": lambda: points_one_by_one(measurement),
        "positions and times": lambda: (
            np.asarray(measurement.to_vec_positions()),
            np.asarray(measurement.to_vec_stamps()),
        ),
        "copied": lambda: points_of(measurement),
        "whole scan": lambda: scan_of(measurement, 10.0),
    }


def _measurement(sensor: str) -> "LidarMeasurement":
    from lio_jax.data.sequence import LidarScan
    from lio_jax.evalio.datasets import SENSOR_SHAPES, measurement_of

    shape = SENSOR_SHAPES[sensor]
    random = np.random.default_rng(0)
    fired = np.flatnonzero(random.random(shape.rows * shape.columns) > 0.1)
    scan = LidarScan(
        stamp_ns=10**18,
        points=random.normal(0, 10, (len(fired), 3)).astype(np.float32),
        time=(fired // shape.rows * 0.1 / shape.columns).astype(np.float32),
        ring=(fired % shape.rows).astype(np.int32),
        intensity=random.random(len(fired)).astype(np.float32),
        duration=0.1,
    )
    return measurement_of(scan, shape)


def _median_ms(read: Callable[[], Any], repeats: int) -> float:
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        read()
        spent.append((time.perf_counter() - start) * 1e3)
    return float(np.median(spent))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--repeats", type=int, default=20, help="readings of each kind")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser.parse_args()


if __name__ == "__main__":
    main()
