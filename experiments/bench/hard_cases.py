"""Measure the recipes where odometry goes wrong: starts at speed, and outages.

python experiments/bench/hard_cases.py starts python experiments/bench/hard_cases.py starts --recipes
default,loam --seeds 5 --lidar-only python experiments/bench/hard_cases.py drive --recording KITTI_RAW_DRIVE
--starts 0 10 20 30 python experiments/bench/hard_cases.py outages [--json]

A start is right if every move after the third scan is within 5 % of the true one, and the last position
within 5 % of the way. A miss is a start that is not right and whose verdict is sound.
"""

import argparse
import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from roads import driven_along, road_scene

from lio_jax.commands.runtime import prepare_jax
from lio_jax.data.detect import open_sequence
from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.run.run import imu_feed, settings_for
from lio_jax.run.track import ScanResult, track
from lio_jax.run.verdict import Verdict
from lio_jax.settings.settings import recipe_settings, with_overrides
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence

Row = dict[str, Any]

KINDS = ("street", "city", "motorway")
SPEEDS = (5.0, 15.0, 25.0, 35.0)
TURNS = (0.0, 0.5)
BEFORE, AFTER = 100, 100
"""Number of scans before an outage and after it."""


def ran(
    sequence: Sequence, scans: Iterable[LidarScan], recipe: str, lidar_only: bool = False
) -> tuple[list[ScanResult], str]:
    """Return a recipe's results over some scans, and the state of the verdict."""
    settings = recipe_settings(recipe)
    if lidar_only and recipe != "loam":
        settings = with_overrides(settings, ["config.imu.use=false"])
    settings, _ = settings_for(sequence, settings)
    imu, _ = imu_feed(sequence, settings)
    results, judge = [], Verdict(settings)
    for result in track(settings, scans, imu):
        judge.take(result)
        results.append(result)
    return results, judge.verdict()["state"]


def relative(results: list[ScanResult], sequence: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Return estimated and true poses (n, 4, 4), each relative to the first."""
    stamps = np.array([one.stamp_ns for one in results])
    truth = sequence.truth()
    assert truth is not None
    true = truth.at(stamps)
    poses = np.array([one.T_world_imu for one in results])[np.isin(stamps, true.stamp_ns)]
    return np.linalg.inv(poses[0]) @ poses, np.linalg.inv(true.poses[0]) @ true.poses


def moves(poses: np.ndarray) -> np.ndarray:
    """Return the distances between consecutive poses, m."""
    return np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)


def starts(options: argparse.Namespace) -> list[Row]:
    """Return whether each start at speed is right."""
    rows = []
    seconds = options.scans * 0.1
    for kind, turn, speed, seed in product(KINDS, TURNS, SPEEDS, range(options.seeds)):
        sequence = SimulatedSequence(
            road_scene(kind, turn / speed, speed * seconds, seed),
            duration_s=seconds,
            seed=seed,
            trajectory=driven_along(turn / speed, speed, seconds),
            imu=None if options.lidar_only else ImuModel(),
        )
        scans = list(sequence.scans())
        for recipe in options.recipes:
            results, state = ran(sequence, scans, recipe, options.lidar_only)
            estimated, true = relative(results, sequence)
            ratio = moves(estimated)[2:] / moves(true)[2:]
            error = np.linalg.norm((estimated - true)[-1, :3, 3])
            right = bool(np.abs(ratio - 1).max() < 0.05 and error < 0.05 * moves(true).sum())
            missed = not right and state == "sound"
            rows.append(
                {
                    "recipe": recipe,
                    "road": kind,
                    "turn": turn,
                    "speed": speed,
                    "seed": seed,
                    "right": right,
                    "missed": missed,
                }
            )
    print(
        "| recipe | road | turn rad/s | " + " | ".join(f"{speed:g} m/s" for speed in SPEEDS) + " | missed |"
    )
    print("| --- | --- | --- |" + " --- |" * (len(SPEEDS) + 1))
    for recipe, kind, turn in product(options.recipes, KINDS, TURNS):
        group = [row for row in rows if (row["recipe"], row["road"], row["turn"]) == (recipe, kind, turn)]
        cells = [sum(row["right"] for row in group if row["speed"] == speed) for speed in SPEEDS]
        words = " | ".join(f"{count} of {options.seeds}" for count in cells)
        print(f"| {recipe} | {kind} | {turn:g} | {words} | {sum(row['missed'] for row in group)} |")
    return rows


def drive(options: argparse.Namespace) -> list[Row]:
    """Return errors of a recorded drive that is begun in motion."""
    rows = []
    sequence = open_sequence(options.recording)
    print("| recipe | from scan | speed, scans 1 to 3 | way, error | height, error | unconverged | verdict |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for recipe, start in product(options.recipes, options.starts):
        scans = sequence.scans(start, options.scans)
        results, state = ran(sequence, scans, recipe, options.lidar_only)
        estimated, true = relative(results, sequence)
        speed = moves(estimated)[:3].sum() / moves(true)[:3].sum() - 1
        way = moves(estimated).sum() / moves(true).sum() - 1
        height = float((estimated - true)[-1, 2, 3])
        failed = sum(bool(one.failure) for one in results)
        rows.append(
            {
                "recipe": recipe,
                "start": start,
                "speed": speed,
                "way": way,
                "height_m": height,
                "failed": failed,
            }
            | {"verdict": state}
        )
        print(
            f"| {recipe} | {start} | {100 * speed:+.1f} % | {100 * way:+.1f} % | {height:+.2f} m | "
            f"{failed} of {len(results)} | {state} |",
            flush=True,
        )
    return rows


def outages(options: argparse.Namespace) -> list[Row]:
    """Return what each recipe loses after an outage in a city at 5 m/s."""
    rows = []
    whole = SimulatedSequence("city", duration_s=0.1 * (BEFORE + 200 + AFTER), seed=3, imu=ImuModel())
    scans = list(whole.scans())
    cases = {
        "no scans for 20 s": [*scans[:BEFORE], *scans[-AFTER:]],
        "covered for 14 s": [
            *scans[:BEFORE],
            *map(covered, scans[BEFORE : BEFORE + 140]),
            *scans[BEFORE + 140 :],
        ],
        "covered from the start": [*map(covered, scans[:140]), *scans[140 : 140 + AFTER]],
    }
    print("| recipe | outage | lost afterwards | error, m | its sigma, m | drift afterwards, m | verdict |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for (name, given), recipe in product(cases.items(), options.recipes):
        results, state = ran(whole, given, recipe, options.lidar_only)
        back = len(results) - AFTER
        lost = sum(bool(one.output.lost) for one in results[back:])
        estimated, true = relative(results, whole)
        error = float(np.linalg.norm((estimated - true)[-1, :3, 3]))
        covariance = results[-1].output.covariance
        sigma = None if covariance is None else float(np.sqrt(np.trace(np.asarray(covariance)[3:6, 3:6])))
        estimated, true = relative(results[back + 5 :], whole)
        drift = float(np.linalg.norm((estimated - true)[-1, :3, 3]))
        rows.append(
            {
                "recipe": recipe,
                "outage": name,
                "lost": lost,
                "error_m": error,
                "sigma_m": sigma,
                "drift_m": drift,
            }
            | {"verdict": state}
        )
        known = "-" if sigma is None else f"{sigma:.2f}"
        print(f"| {recipe} | {name} | {lost} | {error:.2f} | {known} | {drift:.3f} | {state} |", flush=True)
    return rows


def covered(scan: LidarScan) -> LidarScan:
    """Return the returns of something that covers the sensor."""
    points = np.random.default_rng(0).normal(size=(len(scan.points), 3)).astype(np.float32) * 0.15
    return replace(scan, points=points)


SECTIONS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "starts": starts,
    "drive": drive,
    "outages": outages,
}


def main() -> None:
    """Run the chosen section."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("section", choices=SECTIONS)
    parser.add_argument(
        "--recipes", type=lambda text: text.split(","), default="default,fast_lio2,lio_sam,loam"
    )
    parser.add_argument("--seeds", type=int, default=2, help="of starts: roads of each kind")
    parser.add_argument("--scans", type=int, default=12, help="of starts and drive: number of scans")
    parser.add_argument("--recording", type=Path, help="of drive: a recording with truth")
    parser.add_argument("--starts", type=int, nargs="+", default=[0], help="of drive: first scans")
    parser.add_argument("--lidar-only", action="store_true", help="leave the inertial samples out")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    if options.section == "drive" and options.recording is None:
        parser.error("drive: give --recording.")
    prepare_jax()
    rows = SECTIONS[options.section](options)
    if options.json:
        print(json.dumps({"section": options.section, "rows": rows}))


if __name__ == "__main__":
    main()
