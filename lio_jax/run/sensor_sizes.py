"""Sizes of the arrays for features by what the sensor delivers, where the settings leave them open."""

import dataclasses
from collections.abc import Iterable
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.config import FeaturesConfig
from lio_jax.core.settings import Settings
from lio_jax.data.sequence import LidarScan

_LOOKED_AT = 10
"""Scans: in an open place a single one may not show the upper beams, and the very first may be cut short."""
_SLACK = 1.125
"""Room for scans with longer rings than theirs."""
_SURFACE_SHARE = 0.625
"""Of a scan's points; beyond it surface points are thinned evenly."""
_MOST_SURFACE_POINTS = 49152


def with_sensor_sizes(settings: Settings, scans: Iterable[LidarScan]) -> tuple[Settings, list[str]]:
    """Return settings in which no size of ``config.features`` is 0, and a sentence on what was chosen.

    Args:
        settings: of a run.
        scans: of the recording; the first ones decide, by the largest.
    """
    features = settings.config.features
    open_sizes = [name for name in ("rings", "columns", "surface_points") if getattr(features, name) == 0]
    if not open_sizes:
        return settings, []
    fitting = _fitting(list(islice((scan.ring for scan in scans if len(scan.points)), _LOOKED_AT)), features)
    chosen = dataclasses.replace(features, **{name: getattr(fitting, name) for name in open_sizes})
    config = dataclasses.replace(settings.config, features=chosen)
    words = ", ".join(f"config.features.{name}={getattr(chosen, name)}" for name in open_sizes)
    return dataclasses.replace(settings, config=config), [f"Sizes by the first scans: {words}."]


def _fitting(rings_of_points: list[NDArray[np.int32]], features: FeaturesConfig) -> FeaturesConfig:
    known = [ring[ring >= 0] for ring in rings_of_points if (ring >= 0).any()]
    if not known:
        return FeaturesConfig()
    most = max(int(ring.max()) for ring in known) + 1
    counts = np.max([np.bincount(ring, minlength=most) for ring in known], axis=0)
    rings = features.rings or _rounded_up(len(counts), 8)
    longest = int(_SLACK * counts[:rings].max())
    return FeaturesConfig(
        rings=rings,
        columns=max(_rounded_up(longest, 64), 4 * features.neighbours),
        surface_points=min(_rounded_up(int(_SURFACE_SHARE * counts.sum()), 2048), _MOST_SURFACE_POINTS),
    )


def _rounded_up(value: int, step: int) -> int:
    return -(-max(value, 1) // step) * step
