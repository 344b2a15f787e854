"""The plan of a grid of city blocks: their sides as seen from the street, and a lap through the streets."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PITCH = np.array([80.0, 60.0])
"""Distance between street axes along x and y, m."""
HALF_STREET = 7.0
"""Distance from a street's axis to the building line, m."""
BLOCKS = [(i, j) for i in range(-1, 3) for j in range(-1, 3)]
"""Column and row of each block; its low corner is where the axes cross at (column, row) * PITCH."""
LANE = 1.5
"""Distance from a street's axis to the axis of the driven (right) lane, m."""
LAP_BLOCKS = [(0, 0), (1, 0), (0, 1)]
"""The blocks that the lap goes around."""
_CORNERS = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]])
"""Crossings where the lap turns: five left turns and one right turn."""
_START = np.array([2 * PITCH[0] - 27.0, -LANE])


@dataclass(frozen=True)
class Sides:
    """Block sides as seen from the street."""

    start: NDArray[np.float64]
    """Where each side begins, (n, 2) m."""
    along: NDArray[np.float64]
    """Unit direction along each side, (n, 2)."""
    inward: NDArray[np.float64]
    """Unit direction from the street into the block, (n, 2)."""
    length: NDArray[np.float64]
    """Length of each side, (n,) m."""

    def points(
        self, side: NDArray[np.int64], along: NDArray[np.float64], inward: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions (n, 2), m, from the distances along a side and into its block, m."""
        return self.start[side] + along[:, None] * self.along[side] + inward[:, None] * self.inward[side]

    def yaw(self, side: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the heading along each side, rad."""
        return np.arctan2(self.along[side, 1], self.along[side, 0])

    def slots(
        self, pitch: float, margin: float
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Cut every side into equal slots, with a margin (m) left at both ends.

        Returns:
            Index of each slot's side, distance of its middle from the side's start (m), its width (m).
        """
        counts = np.maximum(1, np.round((self.length - 2 * margin) / pitch)).astype(int)
        width = (self.length - 2 * margin) / counts
        side = np.repeat(np.arange(len(counts)), counts)
        number = np.concatenate([np.arange(count) for count in counts])
        return side, margin + (number + 0.5) * width[side], width[side]


def block_sides() -> Sides:
    """Return the sides of all blocks, counterclockwise."""
    starts, alongs = [], []
    for block in BLOCKS:
        low, high = block_corners(block)
        ring = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        starts.append(ring)
        alongs.append(np.roll(ring, -1, axis=0) - ring)
    start, along = np.concatenate(starts), np.concatenate(alongs)
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    return Sides(start, along, np.stack([-along[:, 1], along[:, 0]], axis=1), length)


def block_corners(block: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the low and the high corner of a block's building line, m."""
    low = np.array(block) * PITCH + HALF_STREET
    return low, low + PITCH - 2 * HALF_STREET


def lap() -> NDArray[np.float64]:
    """Return the vertices (n, 2) of a lap in the right lane, m; the lap starts in a street, along +x."""
    corners = _CORNERS * PITCH
    arrive = np.sign(corners - np.roll(corners, 1, axis=0))
    leave = np.sign(np.roll(corners, -1, axis=0) - corners)
    right = np.stack([(arrive + leave)[:, 1], -(arrive + leave)[:, 0]], axis=1)
    return np.vstack([_START, np.roll(corners + LANE * right, -1, axis=0)])
