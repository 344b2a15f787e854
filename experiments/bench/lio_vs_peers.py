"""Compare our LiDAR-inertial recipes with others: time, error, memory and loss of track, in one run.

    python experiments/bench/lio_vs_peers.py [--worlds street city] [--sensors generic32 os1_128]
        [--seeds 0 1 2] [--seconds 40] [--special fast_rotation drone moving_start] [--systems ...] [--json]

Every system runs in a separate process on simulated recordings, in turns scan by scan. Decoding is not timed;
padding, transfer and the return of the pose are. Needs ``pip install lio-jax[bench]``.
"""

import argparse
import json
import os
import tempfile
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from isolated import Maker, Outcome
    from lio_recordings import Recording

_RIVAL = "rko-lio"
_PACKAGES = ("kiss-icp", "rko-lio", "evalio", "jax", "numpy")
_SHIFTS_MS = (-100, -50, 0, 50, 100)
_COLUMNS = {
    "ms_median": "ms",
    "ms_p95": "p95",
    "cpu_ms_median": "cpu ms",
    "ate_m": "ATE m",
    "ate_per_100m": "/100 m",
    "ate_after_5s_m": "after 5 s",
    "rpe_m": "RPE m",
    "rpe_deg": "RPE deg",
    "lost_s": "lost at s",
    "peak_mb": "peak MiB",
    "time_ratio": "time/rko",
    "ate_ratio": "ATE/rko",
}
"""Headings of the table by key."""


def main() -> None:
    """Run the comparison and print it."""
    options = _options()
    # before any thread starts: workers inherit both, so they hold equally for every system
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    from isolated import run
    from lio_makers import instant_of
    from lio_recordings import written

    makers = _makers(options)
    report: dict[str, Any] = {
        "threads": options.threads,
        "versions": {package: version(package) for package in _PACKAGES},
        "pose_instants": {name: instant_of(name) for name in makers},
        "recordings": {},
    }
    kept = nullcontext(options.data) if options.data else tempfile.TemporaryDirectory()
    groups: dict[str, list[dict[str, dict[str, Any]]]] = {}
    with kept as folder:
        for recording in _recordings(options):
            path = written(recording, Path(folder))
            outcomes = run(path, makers, lambda line: print(line, flush=True))
            systems = {name: summary_of(name, outcome, path) for name, outcome in outcomes.items()}
            _add_ratios(systems)
            load = os.getloadavg()[0]
            print_table(f"{recording.name} (load {load:.1f})", systems)
            report["recordings"][recording.name] = {"load": load, "systems": systems}
            groups.setdefault(recording.group, []).append(systems)
    report["means"] = {group: _means(runs) for group, runs in groups.items()}
    for group, runs in groups.items():
        if len(runs) > 1:
            print_table(f"{group}: mean of {len(runs)} seeds", report["means"][group])
    print()
    for name, (instant, reason) in report["pose_instants"].items():
        print(f"{name}: poses compared {instant:g} of the way through the scan ({reason})")
    if options.json:
        print(json.dumps(report))


def _options() -> argparse.Namespace:
    from lio_makers import PEER_NAMES
    from lio_recordings import SPECIAL

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", nargs="*", default=["street", "city"])
    parser.add_argument("--sensors", nargs="+", default=["generic32"], help="of lio-jax sim")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--seconds", type=float, default=40.0, help="length of a recording")
    parser.add_argument("--special", nargs="*", default=[], choices=SPECIAL, help="robustness recordings")
    parser.add_argument("--recipes", nargs="*", default=["default"], help="ours")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="settings of ours")
    parser.add_argument("--systems", nargs="*", default=list(PEER_NAMES), choices=PEER_NAMES, help="peers")
    parser.add_argument("--threads", type=int, default=2, help="for every system")
    parser.add_argument("--data", type=Path, help="keep the recordings here and reuse those there are")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    return parser.parse_args()


def _recordings(options: argparse.Namespace) -> "list[Recording]":
    from lio_recordings import SPECIAL, Recording

    kinds = [(world, sensor, "driven") for sensor in options.sensors for world in options.worlds]
    kinds += [SPECIAL[name] for name in options.special]
    return [
        Recording(world, sensor, seed, options.seconds, motion)  # type: ignore[arg-type]
        for world, sensor, motion in kinds
        for seed in options.seeds
    ]


def _makers(options: argparse.Namespace) -> "dict[str, Maker]":
    from lio_makers import our_maker, our_name, peer_maker

    overrides = tuple(options.set)
    makers = {our_name(recipe): our_maker(recipe, overrides, options.threads) for recipe in options.recipes}
    return makers | {name: peer_maker(name, options.threads) for name in options.systems}


def summary_of(name: str, outcome: "Outcome", path: Path) -> dict[str, Any]:
    """Return time, memory and errors of one system on one recording."""
    from lio_jax.core.errors import LioJaxError

    summary: dict[str, Any] = {
        "scans": len(outcome.milliseconds),
        "poses": len(outcome.poses),
        "died": outcome.died,
        "failures": outcome.failures[:3],
        "failed_scans": len(outcome.failures),
        "peak_mb": outcome.peak_mb,
        "idle_mb": outcome.idle_mb,
    }
    if outcome.milliseconds:
        summary["ms_median"] = float(np.median(outcome.milliseconds))
        summary["ms_p95"] = float(np.percentile(outcome.milliseconds, 95))
        summary["cpu_ms_median"] = float(np.median(outcome.cpu_milliseconds))
    if len(outcome.poses) < _FEWEST_POSES:
        return summary
    try:
        return summary | _errors(name, outcome, path)
    except LioJaxError as error:
        return summary | {"died": f"{outcome.died} its poses cannot be scored: {error}".strip()}


def _errors(name: str, outcome: "Outcome", path: Path) -> dict[str, Any]:
    from lio_makers import instant_of
    from scoring import Reference, lost_after, score

    from lio_jax.data.config import DataConfig
    from lio_jax.data.native import NativeSequence
    from lio_jax.data.trajectory import Trajectory

    sequence = NativeSequence(path, DataConfig())
    truth = sequence.truth()
    assert truth is not None
    reference = Reference("poses", truth.times_body(np.asarray(sequence.info.T_imu_lidar)))
    duration = next(sequence.scans(0, 1)).duration
    instant_ns = round(instant_of(name)[0] * duration * 1e9)
    estimate = outcome.trajectory(instant_ns)
    length = np.linalg.norm(np.diff(reference.trajectory.positions, axis=0), axis=1).sum()
    errors: dict[str, Any] = dict(score(estimate, reference))
    late = estimate.stamp_ns >= reference.trajectory.stamp_ns[0] + 5_000_000_000
    if late.sum() >= _FEWEST_POSES:
        settled = Trajectory(estimate.stamp_ns[late], estimate.poses[late])
        errors["ate_after_5s_m"] = score(settled, reference)["ate_m"]
    return errors | {
        "ate_per_100m": 100 * errors["ate_m"] / length,
        "path_m": float(length),
        "lost_s": lost_after(estimate, reference.trajectory),
        # the smallest error should be at 0: else the assumed instant is wrong
        "ate_shifted_m": {
            shift: score(outcome.trajectory(instant_ns + shift * 1_000_000), reference)["ate_m"]
            for shift in _SHIFTS_MS
        },
    }


_FEWEST_POSES = 20
"""A system with fewer poses than this gets no errors."""


def _add_ratios(systems: dict[str, dict[str, Any]]) -> None:
    rival = systems.get(_RIVAL, {})
    for summary in systems.values():
        for ratio, key in (("time_ratio", "ms_median"), ("ate_ratio", "ate_m")):
            if key in rival and key in summary:
                summary[ratio] = summary[key] / rival[key]


def _means(runs: list[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return the mean of every figure over the seeds that have it, the earliest loss of track, all deaths."""
    means: dict[str, dict[str, Any]] = {}
    for name in runs[0]:
        means[name] = {"died": "; ".join(run[name]["died"] for run in runs if run[name]["died"])}
        for key in _COLUMNS:
            values = [run[name][key] for run in runs if run[name].get(key) is not None]
            if values:
                means[name][key] = min(values) if key == "lost_s" else float(np.mean(values))
    _add_ratios(means)
    return means


def print_table(title: str, systems: dict[str, dict[str, Any]]) -> None:
    """Print the figures of all systems on one recording, or their means."""
    print(f"\n{title}")
    print("  ".join(["system".ljust(12), *(heading.rjust(9) for heading in _COLUMNS.values())]))
    for name, summary in systems.items():
        cells = [_cell(summary.get(key)).rjust(9) for key in _COLUMNS]
        print("  ".join([name.ljust(12), *cells]))
        if summary["died"]:
            print(f"    {summary['died']}")
        if summary.get("failed_scans"):
            print(f"    {summary['failed_scans']} scans failed; {summary['failures'][0]}")
    print(end="", flush=True)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    main()
