"""Differentiable LiDAR-inertial odometry as pure jitted JAX functions.

The names a notebook needs; importing them changes no global setting of JAX. Turn on double precision first
where you want the command line's results: ``jax.config.update("jax_enable_x64", True)``.
"""

from lio_jax.core.config import Config
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.params import Params, default_params
from lio_jax.core.settings import Settings, load_settings, with_overrides
from lio_jax.data import LidarScan, Sequence, Trajectory, open_sequence
from lio_jax.run.run import RunResult, run_sequence, settings_for
from lio_jax.run.track import CompiledStep, Tracked, track

__all__ = [
    "CompiledStep",
    "Config",
    "LidarScan",
    "LioJaxError",
    "Params",
    "RunResult",
    "Sequence",
    "Settings",
    "Tracked",
    "Trajectory",
    "UsageError",
    "default_params",
    "load_settings",
    "open_sequence",
    "run_sequence",
    "settings_for",
    "track",
    "with_overrides",
]
