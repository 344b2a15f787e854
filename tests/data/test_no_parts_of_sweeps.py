"""Messages that are no parts of a turn are scans."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.data import bags, part_recordings
from tests.data.part_recordings import firings, is_joined, opened, parts, recorded, simulated


def full_sweeps() -> list[bags.Message]:
    seen = firings()
    return recorded(seen, parts(seen, bags.PERIOD_NS), bags.PERIOD_NS, part_recordings.velodyne)


def blocked(share: float) -> list[bags.Message]:
    """Whole sweeps of a sensor of which a vehicle covers a share."""
    seen = firings()
    azimuth = np.arctan2(seen.points[:, 1], seen.points[:, 0]) / (2 * np.pi) % 1.0
    cut = parts(seen, bags.PERIOD_NS, azimuth > share)
    return recorded(seen, cut, bags.PERIOD_NS, part_recordings.velodyne)


def solid_state(period_ns: int) -> list[bags.Message]:
    """A sensor with 120 deg of view that looks to and fro, as it is published at 10 or 50 Hz."""
    seen = firings(turns=12 * bags.PERIOD_NS / period_ns, period_ns=period_ns)
    cut = parts(seen, period_ns, seen.points[:, 0] > 0.5 * np.linalg.norm(seen.points[:, :2], axis=1))
    return recorded(seen, cut, period_ns, part_recordings.hesai)


def strips() -> list[bags.Message]:
    """A view of 120 deg in five strips from left to right, again and again."""
    seen = firings(turns=40, period_ns=3 * bags.PERIOD_NS)
    length = 24 * 3 * bags.PERIOD_NS // 360
    cut = [piece for number, piece in enumerate(parts(seen, length)) if number % 15 < 5]
    messages = []
    for number, (begin, kept) in enumerate(cut):
        stamp = bags.START_NS + number * length
        cloud = bags.fill(bags.HESAI, seen.seen(kept), (stamp + seen.since_ns[kept] - begin) * 1e-9)
        messages.append(("/points", stamp + length, bags.cloud_message(stamp, cloud)))
    return messages


def front_and_back() -> list[bags.Message]:
    """Two solid-state sensors of 140 deg, ahead and behind, whose messages take turns on one topic."""
    seen = firings(turns=40)
    ahead = seen.points[:, 0] > np.cos(np.radians(70)) * np.linalg.norm(seen.points[:, :2], axis=1)
    behind = seen.points[:, 0] < -np.cos(np.radians(70)) * np.linalg.norm(seen.points[:, :2], axis=1)
    messages = []
    for number in range(40):
        kept = np.flatnonzero((seen.since_ns // bags.PERIOD_NS == number) & (behind if number % 2 else ahead))
        # each scans its view in 50 ms
        kept = kept[np.argsort(seen.points[kept, 2], kind="stable")]
        times = bags.START_NS * 1e-9 + 0.05 * number + np.linspace(0.0, 0.05, len(kept))
        cloud = bags.fill(bags.HESAI, seen.seen(kept), times)
        stamp = bags.START_NS + number * 50_000_000
        messages.append(("/points", stamp + 52_000_000, bags.cloud_message(stamp, cloud)))
    return messages


@pytest.mark.parametrize(
    "messages",
    [
        full_sweeps,
        lambda: blocked(0.25),
        lambda: blocked(0.7),
        lambda: solid_state(bags.PERIOD_NS),
        lambda: solid_state(bags.PERIOD_NS // 5),
        strips,
        front_and_back,
        lambda: simulated("livox", 1),
        lambda: simulated("livox", 5),
    ],
    ids=[
        *("full", "quarter blocked", "mostly blocked", "solid 10 Hz", "solid 50 Hz", "strips", "two sensors"),
        *("rosette 10 Hz", "rosette 50 Hz"),
    ],
)
def test_what_is_no_part_of_a_turn_is_not_joined(
    tmp_path: Path, messages: Callable[[], list[bags.Message]]
) -> None:
    made = messages()
    sequence = opened(tmp_path / "a.db3", made)
    assert not is_joined(sequence)
    assert sequence.info.scan_count == len(made)
    assert len(list(sequence.scans())) == len(made)
