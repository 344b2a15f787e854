"""Run several systems over the same scans in turns, so that a noisy machine affects all of them equally."""

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from datasets import Dataset
from systems import Pose, System

_PAUSE_S = 0.005
"""Pause before each timed call, s: the thread pool of the previous system can stop spinning."""


@dataclass
class Record:
    """The results of one system on one dataset."""

    milliseconds: list[list[float]] = field(default_factory=list)
    """Times per pass and per scan, ms."""
    poses: list[list[Pose]] = field(default_factory=list)
    """T_world_lidar per pass and per scan."""


def run(
    dataset: Dataset, factories: dict[str, Callable[[], System]], repeats: int, by_scan: bool
) -> dict[str, Record]:
    """Run every system ``repeats`` times over the dataset.

    Args:
        dataset: decoded scans.
        factories: makers of a new system, by name.
        repeats: number of passes.
        by_scan: whether systems take turns scan by scan, else pass by pass; the first one rotates in both
            cases.

    Returns:
        Times and poses of each system; work that is done once (compilation) is not in the times.
    """
    records = {name: Record() for name in factories}
    for factory in factories.values():
        factory().warm_up(dataset.scans)
    for turn in range(repeats):
        order = _rotated(list(factories), turn)
        for group in [order] if by_scan else [[name] for name in order]:
            _pass(dataset, {name: factories[name]() for name in group}, records)
    return records


def _pass(dataset: Dataset, systems: dict[str, System], records: dict[str, Record]) -> None:
    for name in systems:
        records[name].milliseconds.append([])
        records[name].poses.append([])
    gc.collect()
    gc.disable()
    try:
        for number, scan in enumerate(dataset.scans):
            for name in _rotated(list(systems), number):
                prepared = systems[name].prepare(scan)
                time.sleep(_PAUSE_S)
                begin = time.perf_counter()
                pose = systems[name].register(prepared)
                spent = time.perf_counter() - begin
                records[name].milliseconds[-1].append(1e3 * spent)
                # a system that answers late states the scans of its poses
                own = getattr(systems[name], "estimates", None)
                answered = [pose] if own is None else [one for _, one in own]
                records[name].poses[-1] += [np.array(one, np.float64) for one in answered]
                if own is not None:
                    own.clear()
    finally:
        gc.enable()


def _rotated(names: list[str], by: int) -> list[str]:
    by %= len(names)
    return names[by:] + names[:by]
