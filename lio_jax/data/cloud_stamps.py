"""Stamps of the clouds in a folder: from a list of times, from the names of the files, or by counting."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import read_text
from lio_jax.core.timestamps import FARTHEST_NS, seconds_to_ns

TIMES_FILES = ("times.txt", "timestamps.txt")
"""Names of the file that may hold the stamps, one a line."""

_DECIMAL = re.compile(r"(?:^|[^0-9A-Za-z.])(\d+(?:\.\d+)?)$", re.ASCII)
_SECONDS_NANOSECONDS = re.compile(r"(?:^|[^0-9])(?:(\d{9,10})[_-](\d{1,9})|(\d{1,8})[_-](\d{9}))$", re.ASCII)
_LAST_NUMBER = re.compile(r"(\d+)[^0-9]*$", re.ASCII)
_TICKS_NS = (1, 1_000, 1_000_000)
_EPOCH_NS = (10**17, 4 * 10**18)
"""Whole numbers that lie between these as ns, us or ms since 1970 are such times: the years 1973 to 2096."""
_NO_COUNTER_STEPS = 1_000
_SHORTEST_STEP_NS = 1_000_000
_NAMED_AT_MOST = 6


@dataclass(frozen=True)
class CloudStamps:
    """The clouds of a folder in time order."""

    files: tuple[Path, ...]
    stamp_ns: tuple[int, ...]
    """Stamp of each file, ns."""
    counted: bool
    """Whether the recording states no stamps, so that they are counted."""
    note: str


def stamps_of(folder: Path, files: Sequence[Path], period: float) -> CloudStamps:
    """Return the stamps of the clouds of a folder.

    A times file has precedence. Names are read as seconds with a fraction (``1583836591.182590976``), as
    seconds and nanoseconds (``1583836591_182590976``), or as a whole number of ns, us or ms; text may stand
    before them. Other names are in the order of their last number, one period apart; where these numbers
    count the scans, a missing number is a missing scan.

    Args:
        folder: the folder, which may hold a times file.
        files: its clouds, at least one.
        period: time between scans without stamps, s.

    Raises:
        LioJaxError: the times file does not fit the clouds, some names hold numbers and others do not, or
            the files are of several series.
    """
    period_ns = round(period * 1e9)
    times = next((folder / name for name in TIMES_FILES if (folder / name).is_file()), None)
    if times is not None:
        return _by_times(times, files, period_ns)
    names = [path.stem for path in files]
    if stamps := _named_seconds(names) or _named_pairs(names):
        return _sorted(files, stamps, False, "stamps: seconds in the names of the files")
    numbers = _numbers(folder, names)
    if numbers is None:
        return _counted(sorted(files, key=_natural), period, "in the order of their names")
    tick_ns = whole_tick_ns(numbers, period_ns)
    if tick_ns and max(numbers) * tick_ns < FARTHEST_NS:
        unit = {1: "ns", 1_000: "us", 1_000_000: "ms"}[tick_ns]
        stamps = [number * tick_ns for number in numbers]
        return _sorted(files, stamps, False, f"stamps: {unit} in the names of the files")
    if _usual_step(numbers) == 1 and max(numbers) * period_ns < FARTHEST_NS:
        stamps = [number * period_ns for number in numbers]
        return _sorted(files, stamps, True, _counting("by the numbers in their names", period))
    in_order = sorted(zip(numbers, files, strict=True))
    return _counted([path for _, path in in_order], period, "in the order of the numbers in their names")


def times_to_ns(words: Sequence[str], period_ns: int) -> list[int]:
    """Convert times that are written as seconds, or as whole numbers of ns, us or ms.

    Args:
        words: texts of the times.
        period_ns: usual time between them, which separates the units of times that do not count from 1970,
            ns.

    Raises:
        ValueError: a text is no time.
    """
    if all(word.isascii() and word.isdecimal() for word in words):
        numbers = [int(word) for word in words]
        tick_ns = whole_tick_ns(numbers, period_ns)
        if tick_ns and max(numbers) * tick_ns < FARTHEST_NS:
            return [number * tick_ns for number in numbers]
    return [seconds_to_ns(word) for word in words]


def whole_tick_ns(numbers: Sequence[int], period_ns: int) -> int | None:
    """Return the unit of whole numbers that are times, ns; None where they only count.

    Args:
        numbers: the numbers, at least one.
        period_ns: usual time between them, ns.
    """
    low, high = _EPOCH_NS
    for tick_ns in _TICKS_NS:
        if low <= min(numbers) * tick_ns and max(numbers) * tick_ns <= high:
            return tick_ns
    step = _usual_step(numbers)
    if step < _NO_COUNTER_STEPS:
        return None
    return min(_TICKS_NS, key=lambda tick_ns: abs(math.log(step * tick_ns / period_ns)))


def _usual_step(numbers: Sequence[int]) -> float:
    ordered = sorted(set(numbers))
    steps = [later - earlier for earlier, later in pairwise(ordered)]
    return float(np.median(np.array(steps, float))) if steps else 1.0


def _named_seconds(names: Sequence[str]) -> list[int] | None:
    found = [match.group(1) for name in names if (match := _DECIMAL.search(name))]
    if len(found) < len(names) or not any("." in word for word in found):
        return None
    try:
        return [seconds_to_ns(word) for word in found]
    except ValueError:
        return None


def _named_pairs(names: Sequence[str]) -> list[int] | None:
    found = [match.groups() for name in names if (match := _SECONDS_NANOSECONDS.search(name))]
    if len(found) < len(names):
        return None
    stamps = [int(a or c) * 1_000_000_000 + int(b or d) for a, b, c, d in found]
    # counters behind a date look alike
    return stamps if len(set(stamps)) == 1 or _usual_step(stamps) >= _SHORTEST_STEP_NS else None


def _numbers(folder: Path, names: Sequence[str]) -> list[int] | None:
    """Return the last number in each name; None where no name has one."""
    found = [_LAST_NUMBER.search(name) for name in names]
    if not any(found):
        return None
    for name, match in zip(names, found, strict=True):
        if match is None:
            raise LioJaxError(
                f"{folder}: the name '{name}' holds no number, as other names do; move this file elsewhere, "
                f"or give the stamps of all clouds in {TIMES_FILES[0]}."
            )
    matches = [match for match in found if match]
    _check_one_series(folder, matches)
    return [int(match.group(1)) for match in matches]


def _check_one_series(folder: Path, numbers: Sequence[re.Match[str]]) -> None:
    """Raise an error where several series of files share most of their numbers (raw_0, map_0)."""
    series: dict[str, set[int]] = {}
    for match in numbers:
        series.setdefault(match.string[: match.start()], set()).add(int(match.group(1)))
    different = len(set[int]().union(*series.values()))
    repeated = sum(map(len, series.values())) - different
    if 2 * repeated <= different:
        return
    named = ", ".join(f"'{text}'" for text in sorted(series)[:_NAMED_AT_MOST])
    raise LioJaxError(
        f"{folder}: its clouds are of several series with the same numbers ({named}); give a folder with one "
        "file for each scan."
    )


def _by_times(times: Path, files: Sequence[Path], period_ns: int) -> CloudStamps:
    lines = read_text(times, "give one time a line").splitlines()
    words = [line.split("#")[0].strip() for line in lines]
    words = [word for word in words if word]
    try:
        stamps = times_to_ns(words, period_ns) if words else []
    except ValueError as error:
        raise LioJaxError(f"{times}: {error}; give one time a line, in seconds or whole ns.") from None
    ordered = sorted(files, key=_natural)
    numbers = [_LAST_NUMBER.search(path.stem) for path in ordered]
    places = [int(match.group(1)) for match in numbers if match]
    if len(stamps) > len(ordered) == len(places) and max(places) < len(stamps):
        chosen = [stamps[place] for place in places]
        note = f"stamps: {times.name}, by the numbers in the names; it has {len(stamps)} entries, a cut-out"
        return CloudStamps(tuple(ordered), tuple(chosen), False, note)
    if len(stamps) != len(ordered):
        raise LioJaxError(
            f"{times}: holds {len(stamps)} times, the folder {len(ordered)} clouds; give one time for each "
            "cloud, in the order of the names."
        )
    return CloudStamps(tuple(ordered), tuple(stamps), False, f"stamps: {times.name}")


def _sorted(files: Sequence[Path], stamps: Sequence[int], counted: bool, note: str) -> CloudStamps:
    in_order = sorted(zip(stamps, files, strict=True))
    return CloudStamps(tuple(path for _, path in in_order), tuple(at for at, _ in in_order), counted, note)


def _counted(ordered: Sequence[Path], period: float, how: str) -> CloudStamps:
    period_ns = round(period * 1e9)
    stamps = tuple(place * period_ns for place in range(len(ordered)))
    return CloudStamps(tuple(ordered), stamps, True, _counting(how, period))


def _counting(how: str, period: float) -> str:
    return f"stamps: not recorded, scans are taken to be {period:g} s apart {how} (config.data.scan_period)"


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Return a key by which a2 is before a10."""
    parts = re.split(r"([0-9]+)", path.stem)
    return [(1, int(part), "") if place % 2 else (0, 0, part) for place, part in enumerate(parts)]
