"""Differentiable LiDAR-inertial odometry as pure jitted JAX functions.

The names a notebook needs; importing them changes no global setting of JAX. Turn on double precision first
where you want the command line's results: ``jax.config.update("jax_enable_x64", True)``.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lio_jax.core.config import Config
    from lio_jax.core.errors import LioJaxError, UsageError
    from lio_jax.core.params import Params, default_params
    from lio_jax.core.settings import Settings, load_settings, with_overrides
    from lio_jax.data import LidarScan, Sequence, Trajectory, open_sequence
    from lio_jax.evaluation.evaluate import evaluate
    from lio_jax.run.run import RunResult, imu_feed, run_sequence, settings_for
    from lio_jax.run.track import CompiledStep, Tracked, track
    from lio_jax.sim.gps import GpsModel
    from lio_jax.sim.imu import ImuModel
    from lio_jax.sim.sequence import SimulatedSequence
    from lio_jax.tuning.gradient import gradient
    from lio_jax.tuning.objectives import MeanOverScans

_HOMES = {
    "Config": "core.config",
    "LioJaxError": "core.errors",
    "UsageError": "core.errors",
    "Params": "core.params",
    "default_params": "core.params",
    "Settings": "core.settings",
    "load_settings": "core.settings",
    "with_overrides": "core.settings",
    "LidarScan": "data",
    "Sequence": "data",
    "Trajectory": "data",
    "open_sequence": "data",
    "evaluate": "evaluation.evaluate",
    "RunResult": "run.run",
    "imu_feed": "run.run",
    "run_sequence": "run.run",
    "settings_for": "run.run",
    "CompiledStep": "run.track",
    "Tracked": "run.track",
    "track": "run.track",
    "GpsModel": "sim.gps",
    "ImuModel": "sim.imu",
    "SimulatedSequence": "sim.sequence",
    "MeanOverScans": "tuning.objectives",
    "gradient": "tuning.gradient",
}

__all__ = [
    "CompiledStep",
    "Config",
    "GpsModel",
    "ImuModel",
    "LidarScan",
    "LioJaxError",
    "MeanOverScans",
    "Params",
    "RunResult",
    "Sequence",
    "Settings",
    "SimulatedSequence",
    "Tracked",
    "Trajectory",
    "UsageError",
    "default_params",
    "evaluate",
    "gradient",
    "imu_feed",
    "load_settings",
    "open_sequence",
    "run_sequence",
    "settings_for",
    "track",
    "with_overrides",
]


def __getattr__(name: str) -> Any:
    # loaded on first use, so that the command line answers a wrong key without loading JAX
    if name not in _HOMES:
        raise AttributeError(f"module 'lio_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"lio_jax.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
