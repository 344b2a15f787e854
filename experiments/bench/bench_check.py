"""Compare short benchmarks with the committed baseline: what has become slower or less accurate?

    python experiments/bench/bench_check.py [--only WORD ...] [--update] [--json]        (make bench-check)

Each figure is a ratio to a peer or to the plain run, measured in the same run, so that another machine and
its load count little. A figure has moved if it, or the error beside it, is worse than the baseline by more
than its tolerance; the exit status is then 1. Figures whose peer is not installed are skipped
(``pip install lio-jax[bench]``). ``--update`` writes what was measured into the baseline.
"""

import argparse
import importlib.util
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BASELINE = Path(__file__).parent / "baseline.json"
ROOT = Path(__file__).resolve().parents[2]
_HOW_TO_MEND = "restore it from git, or write it anew with --update"


class CheckError(Exception):
    """A sentence for the user."""


@dataclass(frozen=True)
class Measure:
    """A number that a benchmark prints."""

    at: str
    """Its place in the benchmark's JSON: keys joined by "/"; ``name=value`` selects an entry of a list."""
    unit: str
    value: float
    """That of the baseline."""
    tolerance: float
    """Largest relative change in the bad direction."""
    better: str = "lower"
    """lower or higher."""
    over: str = ""
    """Place of the number by which it is divided; empty: none."""

    def moved(self, now: float) -> bool:
        """Return whether a new value is worse than the baseline by more than the tolerance."""
        if self.better == "lower":
            return not now <= self.value * (1 + self.tolerance)
        return not now >= self.value * (1 - self.tolerance)


@dataclass(frozen=True)
class Figure:
    """One row of the table."""

    name: str
    command: str
    needs: tuple[str, ...]
    """Modules without which it cannot be measured."""
    ratio: Measure
    error: Measure | None
    """Error or cost of the same run, in its own unit."""

    @property
    def measures(self) -> list[Measure]:
        """Return its numbers."""
        return [self.ratio] if self.error is None else [self.ratio, self.error]


def main() -> int:
    """Measure, print the table, and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD", help="figures whose name has it")
    parser.add_argument("--update", action="store_true", help="write the values into the baseline")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    try:
        figures = chosen(baseline(BASELINE), options.only)
        wanted, skipped = available(figures)
        for line in skipped:
            print(line)
    except CheckError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    now, failed = measured(wanted)
    table, moved = compared([one for one in wanted if one.name in now], now)
    print(table)
    for line in failed:
        print(f"error: {line}", file=sys.stderr)
    if options.update:
        _update(now)
    if options.json:
        print(json.dumps({"now": now, "moved": moved}))
    if failed:
        return 2
    return 1 if moved and not options.update else 0


def baseline(path: Path) -> list[Figure]:
    """Read the baseline.

    Raises:
        CheckError: it is missing, or is no JSON of the expected form.
    """
    try:
        return [_figure(one) for one in json.loads(path.read_text())["figures"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise CheckError(f"{path}: is no baseline ({reason}); {_HOW_TO_MEND.split(',')[0]}.") from None


def _figure(held: dict[str, Any]) -> Figure:
    error = held.get("error")
    measures = Measure(**held["ratio"]), None if error is None else Measure(**error)
    for one in filter(None, measures):
        if one.better not in ("lower", "higher"):
            raise ValueError(f"{held['name']} is neither better when lower nor when higher")
    return Figure(held["name"], held["command"], tuple(held["needs"]), *measures)


def chosen(figures: Sequence[Figure], words: Sequence[str]) -> list[Figure]:
    """Return the figures whose names contain one of the words; all without words.

    Raises:
        CheckError: no figure has a word in its name.
    """
    for word in words:
        if not any(word in one.name for one in figures):
            names = "; ".join(one.name for one in figures)
            raise CheckError(f"no figure is called '{word}'; there are: {names}.")
    return [one for one in figures if not words or any(word in one.name for word in words)]


def available(figures: Sequence[Figure]) -> tuple[list[Figure], list[str]]:
    """Return the figures that can be measured here, and a sentence on each of the others."""
    wanted, skipped = [], []
    for one in figures:
        missing = [module for module in one.needs if importlib.util.find_spec(module) is None]
        if missing:
            skipped.append(
                f"skipped: {one.name} ({', '.join(missing)} is not installed; pip install lio-jax[bench])"
            )
        else:
            wanted.append(one)
    return wanted, skipped


def measured(figures: Sequence[Figure]) -> tuple[dict[str, list[float]], list[str]]:
    """Run the benchmarks once each; return the figures' values, and a sentence on each failure."""
    now, failed = {}, []
    for command in dict.fromkeys(one.command for one in figures):
        try:
            output = _output(command)
            now |= {one.name: values_of(one, output) for one in figures if one.command == command}
        except CheckError as error:
            failed.append(str(error))
    return now, failed


def values_of(figure: Figure, output: Any) -> list[float]:
    """Return a figure's ratio, and its error if it has one, from a benchmark's JSON.

    Raises:
        CheckError: the benchmark does not print them.
    """
    return [
        _value_at(output, one.at, figure) / (_value_at(output, one.over, figure) if one.over else 1.0)
        for one in figure.measures
    ]


def _value_at(output: Any, at: str, figure: Figure) -> float:
    found = output
    try:
        for key in at.split("/"):
            if isinstance(found, list):
                name, _, value = key.partition("=")
                found = next(one for one in found if str(one[name]) == value)
            else:
                found = found[key]
        return float(found)
    except (KeyError, StopIteration, TypeError, ValueError):
        raise CheckError(f"{figure.name}: '{figure.command}' prints no number at '{at}'.") from None


def compared(figures: Sequence[Figure], now: dict[str, list[float]]) -> tuple[str, list[str]]:
    """Return the table of figures, baseline and now, and the names of those that have moved."""
    width = max([len(one.name) for one in figures], default=6)
    lines = [f"{'figure':{width}}  {'baseline':>9} {'now':>9} {'limit':>7}   error: baseline, now"]
    moved = []
    for one in figures:
        pairs = list(zip(one.measures, now[one.name], strict=True))
        worse = any(measure.moved(value) for measure, value in pairs)
        if worse:
            moved.append(one.name)
        line = f"{one.name:{width}}  {one.ratio.value:9.4g} {now[one.name][0]:9.4g} {_limit(one.ratio):>7}"
        for error, value in pairs[1:]:
            line += f"   {error.value:.6g} {error.unit}, {value:.6g} ({_limit(error)})"
        lines.append(line + ("   MOVED" if worse else ""))
    last = f"moved: {', '.join(moved)}" if moved else f"none of {len(figures)} figures moved"
    return "\n".join([*lines, last]), moved


def _limit(measure: Measure) -> str:
    return f"{'+' if measure.better == 'lower' else '-'}{100 * measure.tolerance:g}%"


def _output(command: str) -> Any:
    """Run a benchmark and return the JSON on its last line."""
    print(f"running {command}", flush=True)
    words = [sys.executable, *shlex.split(command), "--json"]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    ended = subprocess.run(
        words, cwd=ROOT, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False
    )
    lines = (ended.stdout.strip() or "none").splitlines()
    try:
        if ended.returncode == 0:
            return json.loads(lines[-1])
    except ValueError:
        pass
    reason = (ended.stderr.strip() or lines[-1]).splitlines()[-1]
    raise CheckError(f"'{command}' failed with status {ended.returncode}: {reason}")


def _update(now: dict[str, list[float]]) -> None:
    held = json.loads(BASELINE.read_text())
    for one in held["figures"]:
        for key, value in zip(("ratio", "error"), now.get(one["name"], []), strict=False):
            one[key]["value"] = float(f"{value:.6g}")
    BASELINE.write_text(json.dumps(held, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(main())
