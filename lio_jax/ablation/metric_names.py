"""The numbers that a run's metrics.json holds, by their paths."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from lio_jax.evaluation.kitti_segments import SegmentErrors
from lio_jax.evaluation.trajectory_error import PoseError

_STAGES = ("decode", "pad", "step", "record", "total")

METRICS: dict[str, str] = {
    "failed_scans": "",
    "scans": "",
    "path_length_m": "m",
    **{
        f"{group}.{field.name}": "" if field.name == "samples" else "rad" if "rotation" in field.name else "m"
        for group in ("ate", "rpe")
        for field in dataclasses.fields(PoseError)
    },
    **{
        f"{group}.{field.name}": {"translation_percent": "%", "rotation_deg_per_m": "deg/m"}.get(
            field.name, ""
        )
        for group in ("kitti", "kitti_short_10_80m")
        for field in dataclasses.fields(SegmentErrors)
    },
    **{f"scan_ms.{stage}.{value}": "ms" for stage in _STAGES for value in ("median", "p95", "p99")},
    "compile_s": "s",
    "wall_s": "s",
}
"""By path, with units; of all of them less is better, or they are mere counts."""

DEFAULT_METRICS = ("ate.rmse", "ate.rotation_rmse", "rpe.rmse", "failed_scans", "scan_ms.total.median")

TIME = "scan_ms.total.median"
"""What a scan costs."""


def is_timing(metric: str) -> bool:
    """Return whether a metric differs from run to run on one machine."""
    return METRICS.get(metric) in ("ms", "s")


def numbers_in(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of a metrics.json by the names above."""
    flat = {"failed_scans": float(len(metrics.get("failures", ())))}
    for name in METRICS:
        value: Any = metrics
        for part in name.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if isinstance(value, int | float):
            flat[name] = float(value)
    return flat
