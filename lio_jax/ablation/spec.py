"""An ablation's specification: its YAML file, checked, and the metrics it may ask for."""

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from lio_jax.ablation.sources import RECORDED_KEYS, SIMULATED_KEYS, Source, recorded, simulated
from lio_jax.ablation.variants import KINDS, Overrides, Variant, overrides_of, variants
from lio_jax.core.errors import UsageError
from lio_jax.core.files import parse_yaml, read_text
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
"""Units of the metrics by their paths in metrics.json; they are counts, or smaller values are better."""

DEFAULT_METRICS = ("ate.rmse", "ate.rotation_rmse", "rpe.rmse", "failed_scans", "scan_ms.total.median")

TIME = "scan_ms.total.median"
"""Metric for the time of a scan."""


def numbers_in(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of a metrics.json by the paths of METRICS."""
    flat = {"failed_scans": float(len(metrics.get("failures", ())))}
    for name in METRICS:
        value: Any = metrics
        for part in name.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        if isinstance(value, int | float):
            flat[name] = float(value)
    return flat


Keep = Literal["trajectory", "everything"]


@dataclass(frozen=True)
class Spec:
    """A checked specification."""

    name: str
    sources: list[Source]
    variants: list[Variant]
    baseline: Variant
    metrics: tuple[str, ...]
    keep: Keep
    batch: int | None
    """Number of parameter sets in one program; None: depends on the device."""
    text: str
    """Text of the file."""


def load_spec(path: Path) -> Spec:
    """Read and check a specification.

    Raises:
        UsageError: not readable, not YAML, an unknown key, an impossible value, or nothing to compare; the
            sentence names file and key, and the nearest valid key.
    """
    try:
        text = read_text(path, "give a YAML specification", UsageError)
        tree = parse_yaml(text)
    except OSError as error:
        raise UsageError(f"{path}: the specification cannot be read ({error.strerror}).") from None
    except ValueError as error:
        raise UsageError(f"{path}: not valid YAML ({error}).") from None
    place = str(path)
    if not isinstance(tree, dict):
        raise UsageError(f"{place}: must hold sequences and one of {', '.join(KINDS)}, not {tree!r}.")
    _check_keys(tree, _KEYS, place)
    recipe = _typed(tree, "recipe", str, place, "default")
    common = _overrides(tree.get("set") or {}, f"{place}: set")
    wanted = overrides_of(tree, place)
    baseline = _overrides(tree["baseline"] or {}, f"{place}: baseline") if "baseline" in tree else None
    if baseline is not None:
        named = next((pair for pair in wanted if pair[1] == baseline), ("", baseline))
        wanted = [named, *(pair for pair in wanted if pair is not named)]
    compared = variants(wanted, recipe, common, path.parent, place)
    return Spec(
        name=_typed(tree, "name", str, place, path.stem),
        sources=_sources(tree, path.parent, place),
        variants=compared,
        baseline=compared[0],
        metrics=_metrics(tree, place),
        keep=_keep(tree, place),
        batch=_batch(tree, place),
        text=text,
    )


_KEYS = (
    "name",
    "recipe",
    "set",
    "sequences",
    "seeds",
    *KINDS,
    "baseline",
    "metrics",
    "keep",
    "batch",
)


def _sources(tree: dict[str, Any], folder: Path, place: str) -> list[Source]:
    entries = tree.get("sequences")
    if not isinstance(entries, list) or not entries:
        raise UsageError(f"{place}: sequences must be a list, for example - {{sim: street, duration: 10}}.")
    seeds = tree.get("seeds", [0])
    if not isinstance(seeds, list) or not seeds or not all(type(seed) is int and seed >= 0 for seed in seeds):
        raise UsageError(f"{place}: seeds = {seeds!r} must be a list of whole numbers from 0 on.")
    sources: list[Source] = []
    for number, entry in enumerate(entries, 1):
        here = f"{place}: sequences, entry {number}"
        if not isinstance(entry, dict) or ("path" in entry) == ("sim" in entry):
            raise UsageError(f"{here}: must hold either path (a recording) or sim (a world), not {entry!r}.")
        known = RECORDED_KEYS if "path" in entry else SIMULATED_KEYS
        _check_keys(entry, tuple(known), here)
        checked = {key: _typed(entry, key, known[key], here) for key in entry}
        if checked.get("start", 0) < 0 or checked.get("scans", 1) < 1 or checked.get("duration", 1.0) <= 0:
            raise UsageError(f"{here}: start must be 0 or more, scans 1 or more, duration above zero.")
        if "path" in entry:
            sources += recorded(checked, folder, here)
        else:
            sources += simulated(checked, tuple(dict.fromkeys(seeds)), here)
    names = [(source.name, source.seed) for source in sources]
    if twice := next((name for name, seed in names if names.count((name, seed)) > 1), None):
        raise UsageError(f"{place}: two sequences are named '{twice}'; give each a name of its own.")
    return sources


def _metrics(tree: dict[str, Any], place: str) -> tuple[str, ...]:
    metrics = tree.get("metrics", list(DEFAULT_METRICS))
    if not isinstance(metrics, list) or not metrics:
        raise UsageError(f"{place}: metrics = {metrics!r} must be a list such as [ate.rmse].")
    for metric in metrics:
        if not isinstance(metric, str) or metric not in METRICS:
            raise UsageError(f"{place}: metrics: unknown metric '{metric}'; {_nearest(str(metric), METRICS)}")
    return tuple(metrics)


def _keep(tree: dict[str, Any], place: str) -> Keep:
    keep = tree.get("keep", "trajectory")
    if keep not in get_args(Keep):
        raise UsageError(f"{place}: keep = {keep!r} must be one of {', '.join(get_args(Keep))}.")
    return keep


def _batch(tree: dict[str, Any], place: str) -> int | None:
    batch = tree.get("batch", "auto")
    if batch == "auto":
        return None
    if type(batch) is not int or batch < 1:
        raise UsageError(f"{place}: batch = {batch!r} must be auto or a whole number of at least 1.")
    return batch


def _overrides(tree: Any, place: str) -> Overrides:
    if not isinstance(tree, dict):
        raise UsageError(f"{place} = {tree!r} must be overrides such as {{params.map.voxel_size: 1.0}}.")
    return {str(path): value for path, value in tree.items()}


def _check_keys(tree: dict[Any, Any], known: tuple[str, ...], place: str) -> None:
    for key in tree:
        if key not in known:
            raise UsageError(f"{place}: unknown key '{key}'; {_nearest(str(key), known)}")


def _nearest(word: str, known: Any) -> str:
    return f"did you mean '{difflib.get_close_matches(word, list(known), 1, 0.0)[0]}'?"


def _typed(tree: dict[str, Any], key: str, kind: type, place: str, default: Any = None) -> Any:
    value = tree.get(key, default)
    fits = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    if kind is float and type(value) is int:
        return float(value)
    if not fits:
        wanted = {str: "text", int: "a whole number", float: "a number", bool: "true or false"}
        raise UsageError(f"{place}: {key} = {value!r} must be {wanted[kind]}.")
    return value
