"""Settle from a recording's first messages whether they hold parts of a sweep, and how they are read."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice, pairwise

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.cloud_fields import RawCloud
from lio_jax.data.config import DataConfig
from lio_jax.data.joined_messages import Joining, Part, grouped, order_of
from lio_jax.data.scan_reading import (
    SCANS_LOOKED_AT,
    ScanReading,
    first_clouds,
    recognise_clouds,
    recognise_rings,
    recognise_times,
)
from lio_jax.data.time_order import ascending
from lio_jax.data.turning import SeenMessage, arc_of, may_be_parts, recognised_turning, seen_message

LOOKED_AT_NS = 1_000_000_000
"""Time within which parts of a sweep are recognised, ns: five turns at 5 Hz."""
_MOST_LOOKED_AT, _MOST_POINTS = 3000, 2_000_000
_LIVOX_RING = "line"
"""Name of the ring field of all Livox drivers. Their messages hold what was measured in a time that the user
has set, so each is a scan unless the settings join them."""


def recognise_messages(
    clouds: Iterable[tuple[RawCloud, int]], config: DataConfig, where: str
) -> tuple[ScanReading, Joining | None] | None:
    """Settle how messages become scans; None where there are no messages.

    Args:
        clouds: each message's cloud with the time of its receipt, ns, in recorded order; those of the first
            second are taken if they may be parts of a sweep, else the first few.
        config: settings that override what is recognised.
        where: what is read, in errors.

    Returns:
        how a scan's cloud is read, and how messages are joined to it; None for that if each is a scan.

    Raises:
        UsageError: the settings name a number of beams that the points do not fit.
    """
    source = iter(clouds)
    firsts = first_clouds(source)
    wanted = config.messages_per_scan
    if not firsts:
        return None
    if wanted >= 2 or (wanted == 0 and narrow([cloud for cloud, _ in firsts])):
        taken = [cloud for cloud, _ in _of_a_second(chain(firsts, source))]
        each = recognise_times(firsts, config, called="message")
        found = recognise_joining(taken, each, config, where)
        if found is not None:
            return found
    reading = recognise_clouds(firsts, config, where, known_whole=wanted == 1)
    return None if reading is None else (reading, None)


def narrow(clouds: Sequence[RawCloud]) -> bool:
    """Return whether messages are narrow enough to be parts of a sweep, and not those of a Livox driver."""
    arcs = [arc_of(cloud.points) for cloud in clouds if cloud.ring_source != _LIVOX_RING]
    return may_be_parts([arc for arc in arcs if arc is not None])


def _of_a_second(clouds: Iterator[tuple[RawCloud, int]]) -> Iterator[tuple[RawCloud, int]]:
    begin_ns: int | None = None
    points = 0
    for count, (cloud, received_ns) in enumerate(islice(clouds, _MOST_LOOKED_AT)):
        begin_ns = cloud.stamp_ns if begin_ns is None else begin_ns
        points += len(cloud.points)
        late = cloud.stamp_ns > begin_ns + LOOKED_AT_NS or points > _MOST_POINTS
        if count >= SCANS_LOOKED_AT and late:
            return
        yield cloud, received_ns


def recognise_joining(
    clouds: Sequence[RawCloud], each: ScanReading, config: DataConfig, where: str
) -> tuple[ScanReading, Joining] | None:
    """Settle how messages are joined; None if each is a scan.

    Args:
        clouds: messages of about a second in recorded order, at least one.
        each: how a message's times are read.
        config: settings that override what is recognised.
        where: what is read, in errors.

    Raises:
        UsageError: the settings name a number of beams that the points do not fit.
    """
    joining = _joining(clouds, each, config)
    if joining is None:
        return None
    return _joined_reading(clouds, each, joining, config, where), joining


def _joining(clouds: Sequence[RawCloud], each: ScanReading, config: DataConfig) -> Joining | None:
    """Return how messages are joined; None if they are whole scans."""
    compensated = config.compensated == "yes"
    wanted = config.messages_per_scan
    unknown = Joining(None, max(wanted, 1), each.sweep, each.timing, each.stamp_at, compensated)
    starts = [unknown.start_ns(cloud) for cloud in clouds]
    # duplicates, messages out of order and wrong stamps say nothing
    kept = ascending(starts)
    kept = [place for place in kept if starts[place] <= starts[kept[0]] + 2 * LOOKED_AT_NS]
    steps = [starts[later] - starts[earlier] for earlier, later in pairwise(kept)]
    step = float(np.median(steps)) * 1e-9 if steps else config.scan_period
    turning = None if compensated else recognised_turning(_seen(clouds, starts, kept, unknown, step))
    if turning is not None and wanted in (0, round(turning.messages)):
        return replace(unknown, turning=turning, messages=turning.messages, step=step)
    return replace(unknown, messages=wanted, step=step) if wanted else None


def _seen(
    clouds: Sequence[RawCloud], starts: Sequence[int], kept: Sequence[int], each: Joining, step: float
) -> list[SeenMessage]:
    """Return what the kept messages with points show."""
    seen: list[SeenMessage] = []
    earlier_low = 0.0
    for cloud, start_ns in ((clouds[place], starts[place]) for place in kept):
        seconds: NDArray[np.float64] | None = None
        low = 0.0
        limits = each.limits(cloud)
        # times of which some are impossible say nothing
        all_possible = limits is not None and limits == cloud.time_range
        if each.timing is not None and cloud.time is not None and limits is not None and all_possible:
            tick = each.timing.tick_ns * 1e-9
            seconds = (cloud.time - cloud.time.dtype.type(limits[0])).astype(np.float64) * tick
            low = limits[0] * tick
        # times that run on over a sweep fall back by most of it, those of one message by less than a message
        restarts = len(seen) > 0 and low < earlier_low - 1.5 * step
        one = seen_message(start_ns, cloud.points, seconds, restarts)
        if one is not None:
            seen.append(one)
            earlier_low = low
    return seen


def _joined_reading(
    clouds: Sequence[RawCloud], each: ScanReading, joining: Joining, config: DataConfig, where: str
) -> ScanReading:
    parts = [Part(place, joining.start_ns(cloud), cloud) for place, cloud in enumerate(clouds)]
    sweeps = grouped(parts, order_of(joining), True)
    wholes = [joining.whole([part.cloud for part in sweep]) for sweep in islice(sweeps, SCANS_LOOKED_AT)]
    beams, ring_notes = recognise_rings(wholes, config, where)
    timing = joining.whole_timing()
    period = 0.0 if timing is None else joining.period
    notes = (*each.notes, *ring_notes, _note(joining, config))
    return ScanReading(timing, "start", period, beams, notes)


def _note(joining: Joining, config: DataConfig) -> str:
    turning = joining.turning
    if turning is None:
        return (
            f"{round(joining.messages)} messages are joined to a scan of {joining.period:.3g} s "
            "(config.data.messages_per_scan)"
        )
    number = f"{joining.messages:.4g}"
    start = round(np.degrees(turning.start)) % 360
    sentence = (
        f"each message holds a part of a turn: {number} messages are joined to a scan of "
        f"{joining.period:.3g} s, which starts at {start} deg of azimuth"
    )
    if config.messages_per_scan:
        return f"{sentence} (config.data.messages_per_scan)"
    return f"{sentence}; --set config.data.messages_per_scan=1 reads each message as a scan"
