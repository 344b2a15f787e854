"""Differentiable LiDAR-inertial odometry as pure jitted JAX functions.

The names a notebook needs; importing them changes no global setting of JAX. Turn on double precision first
where you want the command line's results: ``jax.config.update("jax_enable_x64", True)``.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lio_jax.ablation.in_process import run_ablation
    from lio_jax.core.config import Config
    from lio_jax.core.errors import LioJaxError, UsageError
    from lio_jax.core.params import Params, default_params
    from lio_jax.core.settings import Settings, load_settings, recipe_settings, with_overrides
    from lio_jax.data import LidarScan, Sequence, Trajectory, open_sequence
    from lio_jax.evaluation.evaluate import evaluate
    from lio_jax.imu.path import deskew_along
    from lio_jax.lidar.features import lio_sam_features, loam_features
    from lio_jax.mapping.voxel_map import anchor_of
    from lio_jax.recipes.inertial_filter import lidar_pose, predicted
    from lio_jax.registration.scan_to_map import Frame, associate, point_noise
    from lio_jax.run.run import RunResult, imu_feed, run_sequence, settings_for
    from lio_jax.run.track import CompiledStep, Tracked, feed, stepped, track
    from lio_jax.sim.gps import GpsModel
    from lio_jax.sim.imu import ImuModel
    from lio_jax.sim.sequence import SimulatedSequence
    from lio_jax.tuning.gradient import gradient
    from lio_jax.tuning.loss import Loss
    from lio_jax.tuning.named_objectives import objective_named
    from lio_jax.tuning.objectives import MeanOverScans
    from lio_jax.tuning.optimise import Bounds, scoring
    from lio_jax.tuning.parameters import free_parameters
    from lio_jax.tuning.recording import Recording

_HOMES = {
    "run_ablation": "ablation.in_process",
    "Config": "core.config",
    "LioJaxError": "core.errors",
    "UsageError": "core.errors",
    "Params": "core.params",
    "default_params": "core.params",
    "Settings": "core.settings",
    "load_settings": "core.settings",
    "recipe_settings": "core.settings",
    "with_overrides": "core.settings",
    "LidarScan": "data",
    "Sequence": "data",
    "Trajectory": "data",
    "open_sequence": "data",
    "evaluate": "evaluation.evaluate",
    "deskew_along": "imu.path",
    "lio_sam_features": "lidar.features",
    "loam_features": "lidar.features",
    "anchor_of": "mapping.voxel_map",
    "lidar_pose": "recipes.inertial_filter",
    "predicted": "recipes.inertial_filter",
    "Frame": "registration.scan_to_map",
    "associate": "registration.scan_to_map",
    "point_noise": "registration.scan_to_map",
    "RunResult": "run.run",
    "imu_feed": "run.run",
    "run_sequence": "run.run",
    "settings_for": "run.run",
    "CompiledStep": "run.track",
    "Tracked": "run.track",
    "feed": "run.track",
    "stepped": "run.track",
    "track": "run.track",
    "GpsModel": "sim.gps",
    "ImuModel": "sim.imu",
    "SimulatedSequence": "sim.sequence",
    "gradient": "tuning.gradient",
    "Loss": "tuning.loss",
    "objective_named": "tuning.named_objectives",
    "MeanOverScans": "tuning.objectives",
    "Bounds": "tuning.optimise",
    "scoring": "tuning.optimise",
    "free_parameters": "tuning.parameters",
    "Recording": "tuning.recording",
}

__all__ = [
    "Bounds",
    "CompiledStep",
    "Config",
    "Frame",
    "GpsModel",
    "ImuModel",
    "LidarScan",
    "LioJaxError",
    "Loss",
    "MeanOverScans",
    "Params",
    "Recording",
    "RunResult",
    "Sequence",
    "Settings",
    "SimulatedSequence",
    "Tracked",
    "Trajectory",
    "UsageError",
    "anchor_of",
    "associate",
    "default_params",
    "deskew_along",
    "evaluate",
    "feed",
    "free_parameters",
    "gradient",
    "imu_feed",
    "lidar_pose",
    "lio_sam_features",
    "load_settings",
    "loam_features",
    "objective_named",
    "open_sequence",
    "point_noise",
    "predicted",
    "recipe_settings",
    "run_ablation",
    "run_sequence",
    "scoring",
    "settings_for",
    "stepped",
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
