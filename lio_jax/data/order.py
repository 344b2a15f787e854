"""Keep scans in time order: a map must never be fed the past twice."""

from collections.abc import Callable, Iterator

from lio_jax.data.sequence import LidarScan
from lio_jax.data.trajectory import ns_to_seconds


class StampOrder:
    """Accept names whose stamps ascend strictly; report duplicates and steps back in time."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._latest: tuple[int, str] | None = None

    def accept(self, stamp_ns: int, name: str) -> bool:
        """Return whether ``stamp_ns`` is later than all before; else say why ``name`` is left out."""
        if self._latest is not None and stamp_ns <= self._latest[0]:
            latest_ns, latest_name = self._latest
            stamp = ns_to_seconds(stamp_ns)
            if stamp_ns == latest_ns:
                self._warn(
                    f"{name} has the same stamp as {latest_name} ({stamp} s): the duplicate was dropped."
                )
            else:
                back = (latest_ns - stamp_ns) * 1e-9
                self._warn(
                    f"{name} ({stamp} s) is {back:.3f} s older than {latest_name}: out of order, skipped."
                )
            return False
        self._latest = (stamp_ns, name)
        return True


def in_time_order(
    scans: Iterator[LidarScan], warn: Callable[[str], None], first: int = 0
) -> Iterator[LidarScan]:
    """Yield the scans whose stamps ascend strictly; leave out and report the others.

    Args:
        scans: in recorded order.
        warn: called with one sentence for each scan that is left out.
        first: number by which the first of ``scans`` is named.
    """
    order = StampOrder(warn)
    for number, scan in enumerate(scans, first):
        if order.accept(scan.stamp_ns, f"scan {number}"):
            yield scan
