"""Keep scans in time order, so that a map gets no scan twice and one wrong stamp does not end a recording."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, Generic, NamedTuple, TypeVar

from lio_jax.core.timestamps import ns_to_seconds

T = TypeVar("T")

_LEAP_NS = 1_000_000_000
_LEAP_STEPS = 3
"""A step ahead longer than this many times the last step waits for the next scans: gap or wrong stamp."""
_FIRST_LEAP_NS = 300_000_000
"""Longest believed step while no step is known, ns: three steps at 10 Hz, the rate of most lidars."""
_LONGEST_GAP_NS = 3600 * 1_000_000_000
"""Longest believed step at a recording's ends, ns: there, scans on one side only can confirm a stamp."""


class Stamped(NamedTuple, Generic[T]):
    """An item with a time and a name."""

    stamp_ns: int
    """Time of the item, ns."""
    name: str
    """Name of the item in warnings."""
    item: T


def in_time_order(recorded: Iterable[Stamped[T]], warn: Callable[[str], None]) -> Iterator[T]:
    """Yield the items whose stamps ascend strictly.

    Duplicates, steps back in time, and single stamps far ahead of the stamps that follow are left out, with
    one sentence each.

    Args:
        recorded: items in recorded order; up to three of them are read ahead.
        warn: function that takes each sentence.
    """
    latest: Stamped[None] | None = None
    waiting: Stamped[T] | None = None
    leap_ns = _FIRST_LEAP_NS
    for current in _without_a_wrong_start(iter(recorded), warn):
        if waiting is not None and current.stamp_ns > waiting.stamp_ns:
            yield waiting.item
            leap_ns = _leap(waiting, latest)
            latest, waiting = Stamped(waiting.stamp_ns, waiting.name, None), None
        ahead = waiting if waiting is not None and current.stamp_ns == waiting.stamp_ns else latest
        if ahead is not None and current.stamp_ns <= ahead.stamp_ns:
            warn(_late(current, ahead))
            continue
        if waiting is not None:
            warn(_wrong(waiting, current))
            waiting = None
        if latest is not None and current.stamp_ns - latest.stamp_ns > leap_ns:
            waiting = current
            continue
        yield current.item
        leap_ns = _leap(current, latest)
        # without its item, which is as large as a scan
        latest = Stamped(current.stamp_ns, current.name, None)
    if waiting is not None and latest is not None:
        if waiting.stamp_ns - latest.stamp_ns > _LONGEST_GAP_NS:
            warn(_wrong(waiting, latest))
        else:
            yield waiting.item


def ascending(stamps_ns: Sequence[int]) -> list[int]:
    """Return the indices of the stamps that :func:`in_time_order` keeps."""
    numbered = (Stamped(stamp, "", place) for place, stamp in enumerate(stamps_ns))
    return list(in_time_order(numbered, lambda sentence: None))


def _leap(current: Stamped[Any], latest: Stamped[Any] | None) -> int:
    """Return the longest believed step (ns) after the step from ``latest`` to ``current``."""
    if latest is None:
        return _FIRST_LEAP_NS
    return min(_LEAP_NS, _LEAP_STEPS * (current.stamp_ns - latest.stamp_ns))


def _without_a_wrong_start(
    recorded: Iterator[Stamped[T]], warn: Callable[[str], None]
) -> Iterator[Stamped[T]]:
    """Leave out the first item if the next two items agree that its stamp is wrong."""
    head = list(islice(recorded, 3))
    if len(head) == 3:
        first, second, third = (entry.stamp_ns for entry in head)
        too_late = second < third < first
        too_early = second - first > _LONGEST_GAP_NS and 0 < third - second <= _LEAP_NS
        if too_late or too_early:
            warn(_wrong(head[0], head[1]))
            del head[0]
    while head:
        yield head.pop(0)
    yield from recorded


def _late(current: Stamped[Any], ahead: Stamped[Any]) -> str:
    stamp, back = ns_to_seconds(current.stamp_ns), (ahead.stamp_ns - current.stamp_ns) * 1e-9
    if back == 0:
        return f"{current.name} has the same stamp as {ahead.name} ({stamp} s): the duplicate was dropped."
    return f"{current.name} ({stamp} s) is {back:.3f} s older than {ahead.name}: out of order, skipped."


def _wrong(wrong: Stamped[Any], other: Stamped[Any]) -> str:
    away = (wrong.stamp_ns - other.stamp_ns) * 1e-9
    return (
        f"{wrong.name} ({ns_to_seconds(wrong.stamp_ns)} s) is {abs(away):.3f} s "
        f"{'ahead of' if away > 0 else 'behind'} {other.name} and fits none of its neighbours: "
        "a wrong stamp, skipped."
    )
