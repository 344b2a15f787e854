"""Count what the fixed capacities left out of a run, so that it is never left out in silence."""

from typing import Any

import numpy as np

from lio_jax.core.settings import Settings
from lio_jax.run.track import Tracked

_TOLERATED_SHARE = 0.05
"""Share of points without room in the map that is normal at the edge of a well-filled table."""


class Overflow:
    """Sums over the scans of a run."""

    def __init__(self, settings: Settings) -> None:
        self._largest = settings.config.lidar.buckets[-1]
        self._capacity = settings.config.map.capacity
        self._scans_over = 0
        self._thinned_away: list[int] = []
        self._offered = 0
        self._dropped = 0

    def add(self, tracked: Tracked) -> None:
        """Count one scan."""
        output = tracked.output
        self._scans_over += tracked.scan_points > self._largest
        self._thinned_away.append(int(output.thinned_away))
        self._offered += int(np.asarray(output.points_mask).sum())
        self._dropped += int(output.map_dropped)

    def metrics(self) -> dict[str, Any]:
        """Return the sums for metrics.json."""
        return {
            "scans_over_largest_bucket": self._scans_over,
            "cells_thinned_away_per_scan": float(np.median(self._thinned_away)),
            "map_points_offered": self._offered,
            "map_points_dropped": self._dropped,
        }

    def warnings(self) -> list[str]:
        """Return a sentence for each capacity that is too small for this recording."""
        sentences = []
        if self._scans_over:
            sentences.append(
                f"{self._scans_over} scans hold more than {self._largest} points and were thinned to that "
                "many evenly; append a larger size to config.lidar.buckets to use them all."
            )
        if self._dropped > _TOLERATED_SHARE * self._offered:
            sentences.append(
                f"{self._dropped} of {self._offered} points found no room in the map of {self._capacity} "
                "voxels; raise config.map.capacity or lower params.map.reach."
            )
        return sentences
