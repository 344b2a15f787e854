"""Short drives that begin at full speed, on the roads of the benchmark of hard cases."""

import sys
from functools import cache
from pathlib import Path

from lio_jax.run.run import imu_feed, settings_for
from lio_jax.run.track import track
from lio_jax.settings.settings import recipe_settings, with_overrides
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments" / "bench"))

from hard_runs import moves as steps
from hard_runs import relative
from hard_scenes import lift_without_floor
from roads import driven_along, road_scene

__all__ = ["lift_without_floor", "relative", "road", "steps", "tracked"]


@cache
def road(kind, speed, turn, scans, seed=0, imu=True):
    """Return a drive at a constant speed (m/s) and turning rate (rad/s) from the first scan on."""
    seconds = 0.1 * scans + 0.1
    return SimulatedSequence(
        road_scene(kind, turn / speed, speed * seconds, seed),
        duration_s=0.1 * scans,
        seed=seed,
        trajectory=driven_along(turn / speed, speed, seconds),
        imu=ImuModel() if imu else None,
    )


def tracked(sequence, recipe, overrides=(), scans=None, start=0):
    """Return settings and results of a recipe over a recording, or over given scans of it."""
    settings, _ = settings_for(sequence, with_overrides(recipe_settings(recipe), overrides))
    imu, _ = imu_feed(sequence, settings)
    return settings, list(track(settings, sequence.scans(start) if scans is None else scans, imu))
