"""Difference of the clocks of a lidar and of an IMU, by the order in which their messages were received."""

from collections.abc import Callable, Iterable
from contextlib import suppress

import numpy as np

_SCANS = 10
"""Number of scans whose ends are compared with the stamps of the samples received before them."""
_LEAST_NS = 1_000_000_000
"""Clocks that differ by less are left as they are, ns."""


def clock_difference(
    received: Iterable[tuple[bool, bytes]],
    scan_end_ns: Callable[[bytes], int],
    sample_ns: Callable[[bytes], int],
) -> int:
    """Return by how much the lidar's clock is ahead of the IMU's, ns; 0 up to a second.

    Where a scan is received, the last sample received before it was taken at the scan's end: FAST-LIO2's
    time_sync_en, here with the median of some scans.

    Args:
        received: messages of both sensors in the order of receipt, each with whether it is a scan; only the
            first of them are taken.
        scan_end_ns: gives the end of the scan in a message by the lidar's clock, ns; raises ValueError where
            it is damaged.
        sample_ns: gives the stamp of the sample in a message by the IMU's clock, ns; raises ValueError, too.
    """
    last: int | None = None
    differences: list[int] = []
    for is_scan, raw in received:
        # damaged messages are reported where they are read
        with suppress(ValueError):
            if not is_scan:
                last = sample_ns(raw)
            elif last is not None:
                differences.append(scan_end_ns(raw) - last)
        if len(differences) == _SCANS:
            break
    difference = round(float(np.median(differences))) if differences else 0
    return difference if abs(difference) > _LEAST_NS else 0
