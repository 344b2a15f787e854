"""Compare our LiDAR odometry with kiss-icp, small_gicp and LOAM: time per scan and error on the same scans.

    python experiments/bench/lidar_vs_peers.py [--kitti-odometry DIR] [--kitti-raw DIR] [--json]

Without a recording it takes the real ones next to the checkout (../shared/data), or a simulated street if
there are none. Needs ``pip install lio-jax[bench]``.
"""

import argparse
import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from datasets import Dataset
    from interleaved import Record
    from systems import System

OURS = {"lio_jax": "default", "lio_jax-loam": "loam"}
"""Our systems and their recipes."""
PEER_NAMES = ("kiss-icp", "small_gicp", "kiss-icp-no-deskew", "evalio-loam")


def main() -> None:
    """Run the comparison and print it."""
    options = _options()
    # before any thread starts: this limits XLA, and holds equally for every system
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    from interleaved import run

    report: dict[str, Any] = {
        "threads": options.threads,
        "repeats": options.repeats,
        "interleave": options.interleave,
        "pose_instants": {},
        "datasets": {},
    }
    for dataset in _datasets(options):
        factories = _factories(options, dataset)
        report["pose_instants"] = {name: _instant(factory) for name, factory in factories.items()}
        records = run(dataset, factories, options.repeats, by_scan=options.interleave == "scan")
        systems = {name: _summary(dataset, factories[name], record) for name, record in records.items()}
        _add_ratios(systems)
        points = int(np.median([len(scan.points) for scan in dataset.scans]))
        report["datasets"][dataset.name] = {"scans": len(dataset.scans), "points": points, "systems": systems}
        _print_table(dataset.name, report["datasets"][dataset.name])
    for name, instant in report["pose_instants"].items():
        print(f"{name}: poses compared at {instant}")
    if options.json:
        print(json.dumps(report))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for flag in ("--kitti-odometry", "--kitti-raw", "--native", "--data"):
        parser.add_argument(
            flag, type=Path, action="append", default=[], dest="paths", metavar="PATH", help="a recording"
        )
    parser.add_argument("--street", action="store_true", help="the simulated street")
    parser.add_argument("--start", type=int, default=0, help="first scan")
    parser.add_argument("--scans", type=int, help="number of scans (default: all; street: 200)")
    parser.add_argument(
        "--systems",
        default=",".join((*OURS, *PEER_NAMES[:2])),
        help=f"comma separated, of: {', '.join((*OURS, *PEER_NAMES))}",
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="settings of ours")
    parser.add_argument("--repeats", type=int, default=1, help="passes over each recording")
    parser.add_argument(
        "--interleave", choices=("scan", "pass"), default="scan", help="how systems take turns"
    )
    parser.add_argument("--threads", type=int, default=2, help="for every system")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    options.systems = options.systems.split(",")
    if unknown := set(options.systems) - {*OURS, *PEER_NAMES}:
        parser.error(
            f"unknown system {', '.join(sorted(unknown))}; choose from {', '.join((*OURS, *PEER_NAMES))}"
        )
    return options


def _datasets(options: argparse.Namespace) -> "list[Dataset]":
    from datasets import REAL, recorded, simulated

    chosen = [recorded(path, None, options.start, options.scans) for path in options.paths]
    if not chosen and not options.street:
        chosen = [
            recorded(path, name, options.start, options.scans) for name, path in REAL.items() if path.is_dir()
        ]
    return chosen if chosen and not options.street else [*chosen, simulated(options.scans)]


def _factories(options: argparse.Namespace, dataset: "Dataset") -> "dict[str, Callable[[], System]]":
    from systems import PEERS

    makers: dict[str, Callable[[], System]] = {
        name: partial(maker, options.threads) for name, maker in PEERS.items()
    }
    for name in set(OURS) & set(options.systems):
        from lio_jax_system import LioJaxSystem, sizes_for

        overrides = (*sizes_for(OURS[name], dataset.scans), *options.set)
        makers[name] = partial(
            LioJaxSystem, options.threads, dataset.T_imu_lidar, overrides, None, OURS[name]
        )
    return {name: makers[name] for name in options.systems}


def _instant(factory: "Callable[[], System]") -> str:
    system = factory.func  # type: ignore[attr-defined]
    name = {0.0: "scan start", 0.5: "mid-scan", 1.0: "scan end"}[system.instant]
    return f"{name} ({system.instant_reason})"


def _summary(dataset: "Dataset", factory: "Callable[[], System]", record: "Record") -> dict[str, float]:
    from scoring import score

    from lio_jax.data.trajectory import Trajectory

    spent = np.concatenate(record.milliseconds)
    summary = {"ms_median": float(np.median(spent)), "ms_p95": float(np.percentile(spent, 95))}
    if dataset.reference is None:
        return summary
    instant = factory.func.instant  # type: ignore[attr-defined]
    stamps = np.array([scan.stamp_ns + round(instant * scan.duration * 1e9) for scan in dataset.scans])
    scores = [score(Trajectory(stamps, np.array(poses)), dataset.reference) for poses in record.poses]
    return summary | {key: float(np.median([one[key] for one in scores])) for key in scores[0]}


def _add_ratios(systems: dict[str, dict[str, float]]) -> None:
    for peer in PEER_NAMES:
        if peer in systems:
            for summary in systems.values():
                summary[f"time_vs_{peer}"] = summary["ms_median"] / systems[peer]["ms_median"]


def _print_table(name: str, result: dict[str, Any]) -> None:
    print(f"\n{name}: {result['scans']} scans, {result['points']} points each (median)")
    columns = list(next(iter(result["systems"].values())))
    widths = [max(len(column), 8) for column in columns]
    print("  ".join(["system".ljust(12), *(c.rjust(w) for c, w in zip(columns, widths, strict=True))]))
    for system, summary in result["systems"].items():
        cells = [f"{summary[c]:.4g}".rjust(w) for c, w in zip(columns, widths, strict=True)]
        print("  ".join([system.ljust(12), *cells]))


if __name__ == "__main__":
    main()
