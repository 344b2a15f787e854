"""What do faulty inertial samples cost, and what does the run say of them?

    python experiments/bench/imu_faults.py [--recipe default] [--worlds city street] [--seeds 3]
        [--seconds 30] [--faults spikes jump ...] [--set path=value ...] [--json]

Each fault is put into the samples of a simulated drive (32 x 512, MEMS noise). The table shows the error of
the trajectory, its ratio to that of the drive without a fault, and the number of scans that failed; below it
stands each sentence that the run says. ``--faults`` picks by the beginning of the names.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Sequence
from lio_jax.data.trajectory import Trajectory

Fault = Callable[[ImuData, np.random.Generator], ImuData]
_BLOCK = 40
"""Number of samples of a block that a driver sends at once."""


def main() -> None:
    """Run each fault and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--worlds", nargs="+", default=["city", "street"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[3])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--faults", nargs="+", default=[""], metavar="NAME")
    parser.add_argument("--set", nargs="*", default=[], dest="overrides", metavar="PATH=VALUE")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    from lio_jax import ImuModel, SimulatedSequence
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    rows: list[dict[str, Any]] = []
    for world in options.worlds:
        for seed in options.seeds:
            drive = SimulatedSequence(
                world, duration_s=options.seconds, seed=seed, imu=ImuModel(), beams=32, columns=512
            )
            scans, clean = list(drive.scans()), None
            print(f"{world}, seed {seed}\n{'fault':28}{'ATE m':>9}{'ratio':>8}{'failed':>8}")
            for name, fault in FAULTS.items():
                if name != "none" and not name.startswith(tuple(options.faults)):
                    continue
                imu = fault(drive.imu(), np.random.default_rng(seed))
                row = _run(options.recipe, options.overrides, Replayed(drive, scans, imu))
                clean = clean or row["ate_m"]
                row |= {"world": world, "seed": seed, "fault": name, "ratio": row["ate_m"] / clean}
                rows.append(row)
                print(f"{name:28}{row['ate_m']:9.4f}{row['ratio']:8.2f}{row['failed']:8d}")
                print("".join(f"    {sentence}\n" for sentence in row["said"]), end="", flush=True)
    if options.json:
        print(json.dumps({"recipe": options.recipe, "rows": rows}))


class Replayed:
    """A recording with other inertial samples, its scans kept in memory."""

    def __init__(self, sequence: Sequence, scans: list[LidarScan], imu: ImuData) -> None:
        self._sequence, self._scans, self._imu = sequence, scans, imu
        self.info = sequence.info
        self.warnings_so_far: tuple[str, ...] = ()

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield the scans."""
        yield from self._scans[start : None if count is None else start + count]

    def imu(self) -> ImuData:
        """Return the samples."""
        return self._imu

    def gps(self) -> GpsData | None:
        """Return None."""
        return None

    def truth(self) -> Trajectory | None:
        """Return the truth."""
        return self._sequence.truth()


def _run(recipe: str, overrides: list[str], sequence: Sequence) -> dict[str, Any]:
    from lio_jax import evaluate, recipe_settings, with_overrides
    from lio_jax.run.run import imu_feed, settings_for
    from lio_jax.run.set_up_check import SetUpCheck
    from lio_jax.run.track import track

    settings, _ = settings_for(sequence, with_overrides(recipe_settings(recipe), overrides))
    feed, found = imu_feed(sequence, settings)
    check = SetUpCheck(settings, feed.samples if feed else None)
    results = []
    for result in track(settings, sequence.scans(), feed):
        check.take(result)
        results.append(result)
    stamps, poses = (
        np.array([getattr(one, name) for one in results]) for name in ("stamp_ns", "T_world_imu")
    )
    return {
        "ate_m": evaluate(Trajectory(stamps, poses), sequence.truth()).ate.rmse,
        "failed": sum(bool(result.failure) for result in results),
        "said": [
            *found,
            *(feed.warnings() if feed else ()),
            *(one.sentence for one in check.faults.values()),
        ],
    }


def _seconds(imu: ImuData) -> NDArray[np.float64]:
    return np.asarray((imu.stamp_ns - imu.stamp_ns[0]) * 1e-9, np.float64)


def _spikes(imu: ImuData, random: np.random.Generator) -> ImuData:
    """One sample in 200 has one value of either sensor a hundred times too large."""
    changed = {}
    for name in ("gyro", "accel"):
        changed[name] = getattr(imu, name).copy()
        at = np.flatnonzero(random.random(len(imu.stamp_ns)) < 0.005)
        changed[name][at, random.integers(0, 3, len(at))] *= 100
    return replace(imu, **changed)


def _saturated(imu: ImuData, random: np.random.Generator, gyro: float, accel: float) -> ImuData:
    return replace(imu, gyro=np.clip(imu.gyro, -gyro, gyro), accel=np.clip(imu.accel, -accel, accel))


def _stuck(
    imu: ImuData, random: np.random.Generator, name: str, axis: int, start: float, end: float = np.inf
) -> ImuData:
    values = getattr(imu, name).copy()
    part = (_seconds(imu) >= start) & (_seconds(imu) < end)
    values[part, axis] = values[np.argmax(part), axis]
    return replace(imu, **{name: values})


def _sent_twice(imu: ImuData, random: np.random.Generator) -> ImuData:
    """One block in ten follows again, with its stamps."""
    blocks = np.array_split(np.arange(len(imu.stamp_ns)), len(imu.stamp_ns) // _BLOCK)
    rows = np.concatenate([np.tile(block, 1 + (random.random() < 0.1)) for block in blocks])
    return ImuData(imu.stamp_ns[rows], imu.gyro[rows], imu.accel[rows])


def _old_values(imu: ImuData, random: np.random.Generator) -> ImuData:
    """One block in ten holds the values of the block before it."""
    rows = np.arange(len(imu.stamp_ns))
    for start in range(_BLOCK, len(rows) - _BLOCK, _BLOCK):
        if random.random() < 0.1:
            rows[start : start + _BLOCK] -= _BLOCK
    return ImuData(imu.stamp_ns, imu.gyro[rows], imu.accel[rows])


def _missing(imu: ImuData, random: np.random.Generator) -> ImuData:
    rows = random.random(len(imu.stamp_ns)) > 0.2
    return ImuData(imu.stamp_ns[rows], imu.gyro[rows], imu.accel[rows])


def _jump(imu: ImuData, random: np.random.Generator, size: float) -> ImuData:
    late = np.where(_seconds(imu) >= 10.0, round(size * 1e9), 0)
    return replace(imu, stamp_ns=imu.stamp_ns + late)


FAULTS: dict[str, Fault] = {
    "none": lambda imu, random: imu,
    "spikes": _spikes,
    "saturated": partial(_saturated, gyro=0.3, accel=10.5),
    "gyro z stuck for 3 s": partial(_stuck, name="gyro", axis=2, start=10.0, end=13.0),
    "gyro z stuck from 2 s on": partial(_stuck, name="gyro", axis=2, start=2.0),
    "gyro x stuck from 10 s on": partial(_stuck, name="gyro", axis=0, start=10.0),
    "accel x stuck for 3 s": partial(_stuck, name="accel", axis=0, start=10.0, end=13.0),
    "accel z stuck": partial(_stuck, name="accel", axis=2, start=0.0),
    "blocks sent twice": _sent_twice,
    "blocks of old values": _old_values,
    "20 % missing": _missing,
    **{
        f"jump of {size:+g} s": partial(_jump, size=size)
        for size in (0.01, 0.03, 0.1, 0.3, 1.0, -0.01, -0.03, -0.1, -0.3, -1.0)
    },
}
"""Faults by name; times from the first sample."""


if __name__ == "__main__":
    main()
