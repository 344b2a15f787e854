"""Settings that every run has beside those of its recipe: reading, the back end, a known map, output."""

from dataclasses import dataclass
from typing import Literal

import equinox as eqx

from lio_jax.core.leaf import section, static
from lio_jax.data.config import DataConfig
from lio_jax.loops.params import (
    BackendConfig,
    BackendParams,
    GpsParams,
    KnownMapConfig,
    KnownMapParams,
    LoopParams,
    LoopsConfig,
)


@dataclass(frozen=True)
class OutputConfig:
    """Which of the optional files a run folder gets."""

    map: bool = static(True)
    """Write map.pcd."""
    recording: bool = static(True)
    """Write recording.rrd."""
    plot: bool = static(True)
    """Write trajectory.png and timings.png."""
    report: bool = static(True)
    """Write report.html."""
    clouds: Literal["none", "thinned", "all"] = static("none")
    """Write the motion-compensated points of the scans in world into clouds/: those that the recipe adds to
    its map or matches, or all points within the range limits."""
    clouds_interval: int = static(1, least=0)
    """Number of scans per file in clouds/. 0 writes all scans into one file."""
    keyframe_distance: float = static(1.0, "m", above=0)
    """A scan this far from the last keyframe becomes a keyframe of the run folder and of the back end."""
    keyframe_angle: float = static(0.2, "rad", above=0)
    """A scan turned by this much since the last keyframe becomes a keyframe."""


@dataclass(frozen=True)
class RunConfig:
    """Static settings of the reader, the back end, a known map and the run folder."""

    data: DataConfig = section(DataConfig)
    backend: BackendConfig = section(BackendConfig)
    loops: LoopsConfig = section(LoopsConfig)
    known_map: KnownMapConfig = section(KnownMapConfig)
    output: OutputConfig = section(OutputConfig)


class GlobalParams(eqx.Module):
    """Numbers that the back end reads, and the start in a known map."""

    loop: LoopParams = section(LoopParams)
    backend: BackendParams = section(BackendParams)
    gps: GpsParams = section(GpsParams)
    known_map: KnownMapParams = section(KnownMapParams)
