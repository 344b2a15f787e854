"""The selection of LOAM and LIO-SAM as it is described: one ring, one sector, one point at a time."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np


@dataclass(frozen=True)
class Rule:
    """Numbers of the selection."""

    corner_threshold: float = 0.1
    flat_threshold: float = 0.1
    corners: int = 20
    flats: int | None = 4
    sectors: int = 6
    neighbours: int = 5


A_LOAM = Rule()
LIO_SAM = Rule(corner_threshold=1.0, flats=None)


def sector_ends(count: int, rule: Rule) -> list[tuple[int, int]]:
    """Return first and past-the-last place of each sector: the ring without its first and last points."""
    first, length = rule.neighbours, max(count - 2 * rule.neighbours, 0)
    cuts = [first + length * sector // rule.sectors for sector in range(rule.sectors + 1)]
    return list(pairwise(cuts))


def pick_ring(
    smoothness: np.ndarray, is_open: np.ndarray, connected: np.ndarray, count: int, rule: Rule
) -> tuple[list[list[int]], list[list[int]]]:
    """Return the corners and the flat points of each sector of one ring, in the order they are picked.

    Args:
        smoothness: (k,).
        is_open: (k,) whether a point may be picked.
        connected: (k,) whether suppression passes from a point to the one after it.
        count: number of points.
        rule: numbers.
    """
    values, passes = smoothness.tolist(), connected.tolist()
    corner_limit, flat_limit = np.float32(rule.corner_threshold), np.float32(rule.flat_threshold)
    picked = (~is_open).tolist()
    corners, flats = [], []

    def suppress(place: int) -> None:
        picked[place] = True
        for step in range(rule.neighbours):
            if not passes[place + step]:
                break
            picked[place + step + 1] = True
        for step in range(rule.neighbours):
            if not passes[place - step - 1]:
                break
            picked[place - step - 1] = True

    for start, end in sector_ends(count, rule):
        order = (start + np.argsort(smoothness[start:end], kind="stable")).tolist()
        sharp: list[int] = []
        for place in reversed(order):
            if len(sharp) == rule.corners or not values[place] > corner_limit:
                break
            if not picked[place]:
                sharp.append(place)
                suppress(place)
        flat: list[int] = []
        for place in order:
            if len(flat) == rule.flats or not values[place] < flat_limit:
                break
            if not picked[place]:
                flat.append(place)
                suppress(place)
        corners.append(sharp)
        flats.append(flat)
    return corners, flats
