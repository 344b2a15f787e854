"""Time of the feature front ends of LOAM and LIO-SAM: median and 95 % of the time per scan, ms.

    python experiments/bench/features.py [--repeats 100] [--threads 2] [--json]

Scans are simulated; a real HDL-64E scan is added if the recordings are next to the checkout. The scans are on
the device already, each program has run before, and the programs take turns. "image" is the range image,
"rings" ends with smoothness and masks, "features" is the whole front end.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from lio_jax.data.sequence import LidarScan

SENSORS = {"hdl64": (64, 2304, 1800), "generic32": (32, 1024, 1024), "vlp16": (16, 1824, 1800)}
"""Rings, room along a ring, and columns of a turn."""


def main() -> None:
    """Measure and print the table."""
    options = _options()
    # before any thread starts: this limits XLA
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])
    rows = []
    for name, (scan, sizes) in _scans().items():
        for recipe, programs in _programs(scan, sizes).items():
            spent = _timed(programs, options.repeats)
            row: dict[str, Any] = {"scan": name, "points": len(scan.points), "recipe": recipe}
            for stage, milliseconds in spent.items():
                row[f"{stage}_ms"] = float(np.median(milliseconds))
                row[f"{stage}_p95"] = float(np.percentile(milliseconds, 95))
            rows.append(row)
    _print_table(rows)
    if options.json:
        print(json.dumps({"threads": options.threads, "repeats": options.repeats, "rows": rows}))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=100, help="of each program")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


def _scans() -> "dict[str, tuple[LidarScan, tuple[int, int, int]]]":
    from datasets import REAL

    from lio_jax.data.config import DataConfig
    from lio_jax.data.detect import open_sequence
    from lio_jax.sim.sequence import SimulatedSequence

    scans = {
        f"city {sensor}": (next(SimulatedSequence("city", sensor, 5.0).scans(20, 1)), sizes)
        for sensor, sizes in SENSORS.items()
    }
    path = REAL["kitti_odometry_04"]
    if path.is_dir():
        scans["kitti 04"] = (next(open_sequence(path, DataConfig()).scans(3, 1)), SENSORS["hdl64"])
    return scans


def _programs(scan: "LidarScan", sizes: tuple[int, int, int]) -> dict[str, dict[str, Callable[[], Any]]]:
    """Return each recipe's compiled programs, from the first stage to the whole front end."""
    from functools import partial

    import jax
    import jax.numpy as jnp

    from lio_jax.lidar.features import lio_sam_features, lio_sam_rings, loam_features, loam_rings
    from lio_jax.lidar.params import LoamRingConfig
    from lio_jax.lidar.range_image import range_image
    from lio_jax.run.scan_inputs import padded
    from tests.params import DEFAULTS, Config, params_from_values

    rings, room, columns = sizes
    scan_on_device = jax.tree.map(jnp.asarray, padded(scan, None, Config().lidar))
    lio_sam_values = {"features": DEFAULTS["features"] | {"corner_threshold": 1.0, "surface_spacing": 0.4}}
    recipes = {
        "loam": (LoamRingConfig(rings=rings, columns=room), DEFAULTS, loam_rings, loam_features),
        "lio_sam": (
            LoamRingConfig(rings=rings, columns=columns, order="azimuth"),
            DEFAULTS | lio_sam_values,
            lio_sam_rings,
            lio_sam_features,
        ),
    }
    programs: dict[str, dict[str, Callable[[], Any]]] = {}
    for recipe, (features, values, to_rings, to_features) in recipes.items():
        config, params = Config(features=features), params_from_values(values)
        stages = {
            "image": partial(range_image, features),
            "rings": partial(to_rings, config),
            "features": partial(to_features, config),
        }
        programs[recipe] = {
            name: partial(jax.jit(stage), params.lidar if name == "image" else params, scan_on_device)
            for name, stage in stages.items()
        }
    return programs


def _timed(programs: dict[str, Callable[[], Any]], repeats: int) -> dict[str, list[float]]:
    import jax

    for program in programs.values():
        jax.block_until_ready(program())
    spent: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            begin = time.perf_counter()
            jax.block_until_ready(program())
            spent[name].append(1e3 * (time.perf_counter() - begin))
    return spent


def _print_table(rows: list[dict[str, Any]]) -> None:
    stages = ("image", "rings", "features")
    print(f"{'scan':16}{'points':>8}  {'recipe':10}" + "".join(f"{stage:>18}" for stage in stages))
    for row in rows:
        cells = "".join(f"{row[f'{stage}_ms']:10.2f} /{row[f'{stage}_p95']:6.2f}" for stage in stages)
        print(f"{row['scan']:16}{row['points']:8d}  {row['recipe']:10}{cells}")


if __name__ == "__main__":
    main()
