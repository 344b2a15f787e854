"""Measure the recipes where odometry goes wrong: starts at speed, outages, hard scenes and wrong set-ups.

python experiments/bench/hard_cases.py starts [--recipes default,loam] [--seeds 5] [--lidar-only]
python experiments/bench/hard_cases.py drive --recording KITTI_RAW_DRIVE --starts 0 10 20 30
python experiments/bench/hard_cases.py outages [--json FILE]
python experiments/bench/hard_cases.py scenes [--seeds 2] [--scenes "a lift" glass]
    [--recipes default,default:lidar,kiss-icp,rko-lio]
python experiments/bench/hard_cases.py set-ups [--recipes default] [--seeds 7]
python experiments/bench/hard_cases.py verdicts [--seeds 2] [--recording DRIVE ANOTHER_DRIVE]

A scene ends as "inside" if the position's error never exceeds three of the standard deviations that the
system states along it, as "small" if it never exceeds 0.5 m, as "warned" if the run itself names a reason to
doubt it no later than that, and as "NO" otherwise. NAME:lidar is a recipe without inertial samples. A wrong
set-up is found if a fault is named within 20 s. A start is right if every move after the
third scan is within 5 % of the true one, and the last position within 5 % of the way. A trajectory is wrong
from the instant at which its error exceeds 1 m, or 0.3 m and 5 % of the way. A miss is a wrong trajectory
that is called sound until then; a false alarm is a right one that is not called sound. --recipes takes the
peers too: kiss-icp and rko-lio.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from faulty import SET_UPS, Faulty
from hard_runs import PEERS, Judged, in_sigmas, judged, moves, relative
from hard_scenes import HARD_SCENES
from roads import driven_along, road_scene

from lio_jax.commands.runtime import prepare_jax
from lio_jax.core.errors import UsageError
from lio_jax.data.detect import open_sequence
from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import WORLDS, SimulatedSequence

Row = dict[str, Any]

KINDS = ("street", "city", "motorway")
SPEEDS = (5.0, 15.0, 25.0, 35.0)
TURNS = (0.0, 0.5)
BEFORE, AFTER = 100, 100
"""Number of scans before an outage and after it."""


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
            run = judged(sequence, scans, recipe, options.lidar_only)
            estimated, true = relative(run.results, sequence)
            ratio = moves(estimated)[2:] / moves(true)[2:]
            error = np.linalg.norm((estimated - true)[-1, :3, 3])
            right = bool(np.abs(ratio - 1).max() < 0.05 and error < 0.05 * moves(true).sum())
            missed = is_wrong(estimated, true).any() and run.verdict["state"] == "sound"
            rows.append(
                {
                    "recipe": recipe,
                    "road": kind,
                    "turn": turn,
                    "speed": speed,
                    "seed": seed,
                    "right": right,
                    "missed": bool(missed),
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


def is_wrong(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return at which of (n, 4, 4) poses, relative to the first, the trajectory is wrong."""
    error = np.linalg.norm((estimated - true)[:, :3, 3], axis=1)
    way = np.concatenate([[0.0], np.cumsum(moves(true))])
    return (error > 1.0) | (error > np.maximum(0.3, 0.05 * way))


def drive(options: argparse.Namespace) -> list[Row]:
    """Return errors of a recorded drive that is begun in motion."""
    rows = []
    sequence = open_sequence(options.recording[0])
    print("| recipe | from scan | speed, scans 1 to 3 | way, error | height, error | unconverged | verdict |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for recipe, start in product(options.recipes, options.starts):
        scans = sequence.scans(start, options.scans)
        run = judged(sequence, scans, recipe, options.lidar_only)
        estimated, true = relative(run.results, sequence)
        speed = moves(estimated)[:3].sum() / moves(true)[:3].sum() - 1
        way = moves(estimated).sum() / moves(true).sum() - 1
        height = float((estimated - true)[-1, 2, 3])
        failed, state = sum(one.failed for one in run.results), run.verdict["state"]
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
            f"{failed} of {len(run.results)} | {state} |",
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
        run = judged(whole, given, recipe, options.lidar_only)
        results, state = run.results, run.verdict["state"]
        back = len(results) - AFTER
        lost = sum(one.lost for one in results[back:])
        estimated, true = relative(results, whole)
        error = float(np.linalg.norm((estimated - true)[-1, :3, 3]))
        estimated, true = relative(results[back + 5 :], whole)
        drift = float(np.linalg.norm((estimated - true)[-1, :3, 3]))
        rows.append(
            {
                "recipe": recipe,
                "outage": name,
                "lost": lost,
                "error_m": error,
                "sigma_m": run.sigma,
                "drift_m": drift,
            }
            | {"verdict": state}
        )
        known = "-" if run.sigma is None else f"{run.sigma:.2f}"
        print(f"| {recipe} | {name} | {lost} | {error:.2f} | {known} | {drift:.3f} | {state} |", flush=True)
    return rows


TOLERATED_M, TOLERATED_SIGMAS = 0.5, 3.0
"""Error of the position in a scene that needs no warning, m, and in standard deviations."""


def scenes(options: argparse.Namespace) -> list[Row]:
    """Return how each system fares in each hard scene: its error, its own opinion of it, and its warning."""
    rows: list[Row] = []
    print(
        "| system | scene | way, m | last, largest error, m | in sigmas | at 0.5 m: s | warned: s | outcome |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for (name, build), seed in product(HARD_SCENES.items(), range(options.seeds)):
        if options.scenes and name not in options.scenes:
            continue
        sequence = build(seed)
        scans = list(sequence.scans())
        for system in options.recipes:
            row = {"system": system, "scene": name, "seed": seed}
            try:
                run = judged(sequence, scans, system, options.lidar_only)
            except Exception as error:  # a peer may raise any exception
                if system not in PEERS:
                    raise
                rows.append(row | {"outcome": "refused", "words": " ".join(str(error).split())})
                print(f"| {system} | {name} {seed} | | | | | | refused |", flush=True)
                continue
            rows.append(row | _scored(run, sequence))
            print(_line(rows[-1]), flush=True)
    print("\n| system | scene | first warning |\n| --- | --- | --- |")
    for row in rows:
        if row["words"]:
            print(f"| {row['system']} | {row['scene']} {row['seed']} | {row['words']} |")
    return rows


def _scored(run: Judged, sequence: Sequence) -> Row:
    """Return errors of a run, in metres and in its own standard deviations, and its first warning."""
    estimated, true = relative(run.results, sequence)
    error = np.linalg.norm((estimated - true)[:, :3, 3], axis=1)
    ratios = in_sigmas(run.results, estimated, true)
    stamps = np.array([one.stamp_ns for one in run.results])
    beyond = np.flatnonzero(error > TOLERATED_M)
    late = float(stamps[beyond[0]] - stamps[0]) * 1e-9 if len(beyond) else None
    warned, words = run.warnings[0] if run.warnings else (None, "")
    sigmas = float(ratios.max()) if np.isfinite(ratios).all() else None
    if sigmas is not None and sigmas <= TOLERATED_SIGMAS:
        outcome = "inside"
    elif late is None:
        outcome = "small"
    else:
        outcome = "warned" if warned is not None and warned <= late else "NO"
    return {
        "way_m": float(moves(true).sum()),
        "last_m": float(error[-1]),
        "error_m": float(error.max()),
        "sigmas": sigmas,
        "late_s": late,
        "warned_s": warned,
        "words": words,
        "outcome": outcome,
    }


def _line(row: Row) -> str:
    sigmas, *times = (
        "-" if row[key] is None else f"{row[key]:.1f}" for key in ("sigmas", "late_s", "warned_s")
    )
    return (
        f"| {row['system']} | {row['scene']} {row['seed']} | {row['way_m']:.0f} | {row['last_m']:.2f}, "
        f"{row['error_m']:.2f} | {sigmas} | {times[0]} | {times[1]} | {row['outcome']} |"
    )


def verdicts(options: argparse.Namespace) -> list[Row]:
    """Return which trajectories are wrong and which are not called sound, over all worlds and recordings."""
    rows = []
    print("| recipe | drive | way, m | largest error, m | wrong at, s | verdict | since, s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, sequence in _drives(options):
        scans = list(sequence.scans())
        for recipe in options.recipes:
            try:
                run = judged(sequence, scans, recipe, options.lidar_only)
            except UsageError:
                print(f"| {recipe} | {name} | needs inertial samples | | | | |", flush=True)
                continue
            estimated, true = relative(run.results, sequence)
            stamps = np.array([one.stamp_ns for one in run.results])
            known = np.isin(stamps, sequence.truth().at(stamps).stamp_ns)  # type: ignore[union-attr]
            wrong = stamps[known][is_wrong(estimated, true)]
            wrong_s = float(wrong[0] - stamps[0]) * 1e-9 if len(wrong) else None
            state, since = run.verdict["state"], run.verdict["since_s"]
            missed = wrong_s is not None and (since is None or since > wrong_s)
            error = float(np.linalg.norm((estimated - true)[:, :3, 3], axis=1).max())
            rows.append(
                {"recipe": recipe, "drive": name, "error_m": error, "wrong_s": wrong_s, "state": state}
                | {"since_s": since, "missed": missed, "false": wrong_s is None and since is not None}
            )
            words = ["-" if value is None else f"{value:.1f}" for value in (wrong_s, since)]
            print(
                f"| {recipe} | {name} | {moves(true).sum():.0f} | {error:.2f} | {words[0]} | {state} | "
                f"{words[1]} |",
                flush=True,
            )
    print("\n| recipe | runs | wrong | of them missed | right | of them false alarms |")
    print("| --- | --- | --- | --- | --- | --- |")
    for recipe in options.recipes:
        own = [row for row in rows if row["recipe"] == recipe]
        wrong_ones = sum(row["wrong_s"] is not None for row in own)
        print(
            f"| {recipe} | {len(own)} | {wrong_ones} | {sum(row['missed'] for row in own)} | "
            f"{len(own) - wrong_ones} | {sum(row['false'] for row in own)} |"
        )
    return rows


def _drives(options: argparse.Namespace) -> Iterator[tuple[str, Sequence]]:
    for world, seed in product(WORLDS, range(options.seeds)):
        yield f"{world} {seed}", SimulatedSequence(world, duration_s=20.0, seed=seed, imu=ImuModel())
    for path in options.recording:
        yield path.name, open_sequence(path)


WORLDS_OF_SET_UPS = ("street", "city", "field")


def set_ups(options: argparse.Namespace) -> list[Row]:
    """Return which faults of the set-up are named, and which are although nothing is wrong."""
    rows = []
    print("| recipe | world | set-up | named | verdict |")
    print("| --- | --- | --- | --- | --- |")
    for world, seed in product(WORLDS_OF_SET_UPS, range(options.seeds)):
        cases = {"right": {}} | (SET_UPS if seed == 0 else {})
        for (name, changes), recipe in product(cases.items(), options.recipes):
            beams = 8 if name == "8 beams" else None
            sequence = _twenty_seconds(world, seed, beams)
            faulty = Faulty(sequence, **changes)
            scans = [faulty.changed(scan) for scan in _scans_of(world, seed, beams)]
            run = judged(faulty, scans, recipe)
            named = [f"{fault.kind} at {fault.since_s:.1f} s" for fault in run.faults]
            rows.append(
                {"recipe": recipe, "world": world, "seed": seed, "set_up": name, "named": named}
                | {"sentences": [fault.sentence for fault in run.faults], "verdict": run.verdict["state"]}
            )
            words = ", ".join(named) or "-"
            print(f"| {recipe} | {world} {seed} | {name} | {words} | {run.verdict['state']} |", flush=True)
    for recipe in options.recipes:
        wrong = [row for row in rows if row["recipe"] == recipe and row["set_up"] != "right"]
        right = [row for row in rows if row["recipe"] == recipe and row["set_up"] == "right"]
        print(
            f"{recipe}: {sum(bool(row['named']) for row in wrong)} of {len(wrong)} named, "
            f"{sum(bool(row['named']) for row in right)} false ones in {len(right)} sound runs"
        )
    return rows


@lru_cache(maxsize=2)
def _twenty_seconds(world: str, seed: int, beams: int | None) -> SimulatedSequence:
    return SimulatedSequence(world, duration_s=20.0, seed=seed, beams=beams, imu=ImuModel())


@lru_cache(maxsize=2)
def _scans_of(world: str, seed: int, beams: int | None) -> list[LidarScan]:
    return list(_twenty_seconds(world, seed, beams).scans())


def covered(scan: LidarScan) -> LidarScan:
    """Return the returns of something that covers the sensor."""
    points = np.random.default_rng(0).normal(size=(len(scan.points), 3)).astype(np.float32) * 0.15
    return replace(scan, points=points)


SECTIONS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "starts": starts,
    "drive": drive,
    "outages": outages,
    "scenes": scenes,
    "set-ups": set_ups,
    "verdicts": verdicts,
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
    parser.add_argument(
        "--recording", type=Path, nargs="+", default=[], help="of drive and verdicts: recordings with truth"
    )
    parser.add_argument("--starts", type=int, nargs="+", default=[0], help="of drive: first scans")
    parser.add_argument("--scenes", nargs="+", choices=HARD_SCENES, help="of scenes: these alone")
    parser.add_argument("--lidar-only", action="store_true", help="leave the inertial samples out")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    if options.section == "drive" and len(options.recording) != 1:
        parser.error("drive: give one --recording.")
    if options.section == "set-ups" and set(options.recipes) & set(PEERS):
        parser.error("set-ups: peers name no faults; give --recipes without them.")
    prepare_jax()
    rows = SECTIONS[options.section](options)
    if options.json:
        print(json.dumps({"section": options.section, "rows": rows}))


if __name__ == "__main__":
    main()
