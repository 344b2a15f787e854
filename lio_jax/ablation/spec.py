"""What an ablation is told: a YAML file, checked strictly.

For example::

    recipe: default                       # or a settings file; what the variants change
    set: {config.map.capacity: 65536}     # holds for all of them
    sequences:
      - {sim: street, duration: 10}
      - path: $KITTI/sequences/{00..10}   # relative to this file; scans: 200 and start: 50 take a part
    seeds: [0, 1, 2]                      # of the simulated ones
    grid: {params.map.voxel_size: [0.8, 1.2], config.imu.use: [true, false]}
    zip: {...}
    random: {count: 20, seed: 0, params.imu.gyro_noise: {log_uniform: [1.0e-4, 1.0e-2]}}
    list: [{name: ours}, {recipe: loam}]
    baseline: {}                          # overrides; what the others are compared with; else the first
    metrics: [ate.rmse, scan_ms.total.median]   # columns of the table; the first one ranks
    keep: trajectory                      # or everything: the whole run folder
    batch: auto                           # parameter sets in one program: auto, or a number

``grid`` takes all combinations, ``zip`` goes through its lists together; all that is asked for is compared.
"""

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from lio_jax.ablation.metric_names import DEFAULT_METRICS, METRICS
from lio_jax.ablation.sources import (
    RECORDED_KEYS,
    SIMULATED_KEYS,
    Source,
    recorded,
    simulated,
)
from lio_jax.ablation.variants import KINDS, Overrides, Variant, overrides_of, variants
from lio_jax.core.errors import UsageError

Keep = Literal["trajectory", "everything"]


@dataclass(frozen=True)
class Spec:
    """A checked ablation."""

    name: str
    sources: list[Source]
    variants: list[Variant]
    baseline: Variant
    metrics: tuple[str, ...]
    keep: Keep
    batch: int | None
    """Parameter sets in one program; None: as the device suggests."""
    text: str
    """The file."""


def load_spec(path: Path) -> Spec:
    """Read and check a specification.

    Raises:
        UsageError: not readable, not YAML, an unknown key or an impossible value, nothing to compare; the
            sentence names file and key, and the nearest valid key.
    """
    try:
        text = path.read_text()
        tree = yaml.safe_load(text)
    except OSError as error:
        raise UsageError(f"{path}: the specification cannot be read ({error.strerror}).") from None
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise UsageError(f"{path}: not valid YAML ({' '.join(str(error).split())}).") from None
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
        if metric not in METRICS:
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
