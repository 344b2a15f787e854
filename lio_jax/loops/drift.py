"""By how much the odometry may be wrong between two keyframes, given the loops that are closed already."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

_ACROSS = 1.0
"""A closed loop is as sure as this much odometry, m."""


class Error(NamedTuple):
    """Largest error of a relative pose that is believed."""

    position: NDArray[np.float64]
    """m."""
    heading: NDArray[np.float64]
    """rad."""


AT_LEAST = Error(np.array(1.0), np.array(0.1))
"""What is possible however short the way: the keyframes' clouds are thinned."""


def possible_error(metres: NDArray[np.float64] | float, limits: dict[str, Any]) -> Error:
    """Return how wrong relative poses may be after so many metres of odometry.

    Args:
        metres: run between the two poses.
        limits: ``params.loop`` as plain numbers.
    """
    run = np.asarray(metres, np.float64)
    position = np.asarray(AT_LEAST.position + limits["drift"] * run)
    heading = np.minimum(AT_LEAST.heading + limits["heading_drift"] * run, np.pi)
    return Error(position, np.asarray(heading))


def metres_from(
    source: int, run: NDArray[np.float64], closed: Sequence[tuple[int, int]]
) -> NDArray[np.float64]:
    """Return the odometry between a keyframe and every other along the shortest way, (k,) m.

    A way may take closed loops as short cuts: after one the drift begins anew.

    Args:
        source: number of the keyframe.
        run: (k,) what the odometry has run up to each, m.
        closed: pairs of keyframes that loops tie together.
    """
    count = len(run)
    if not closed:
        return np.abs(run - run[source])
    first = np.arange(count - 1)
    loops = np.array(closed, np.int64).reshape(-1, 2)
    rows, columns = np.concatenate([first, loops[:, 0]]), np.concatenate([first + 1, loops[:, 1]])
    # a sum of none would be no edge at all
    lengths = np.concatenate([np.maximum(np.diff(run), 1e-6), np.full(len(loops), _ACROSS)])
    # of edges given twice a sparse matrix takes the sum
    key, index = np.unique(rows * count + columns, return_index=True)
    ways = csr_array((lengths[index], (key // count, key % count)), shape=(count, count))
    return dijkstra(ways, directed=False, indices=[source])[0]
