"""Recognise places by the objects around the sensor, independently of drift.

The descriptor is Scan Context (Kim & Kim, "Scan Context: egocentric spatial descriptor for place recognition
within 3D point cloud map", IROS 2018): the height of the highest point in each cell of a polar grid. There
are three differences to the paper. The axes are those of the world, so that the odometry's heading limits the
possible rotations. The newest keyframe is also described from some metres to its sides, for a second pass in
another lane. The places with the most similar keys are compared at all rotations at once, by products of
Fourier transforms.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, rfft

from lio_jax.loops.keyframe import Keyframe

_Array = NDArray[np.floating]

_BELOW = 2.5
"""Height of the origin of heights below the sensor, m: the ground is less than this below it."""
_ASIDE = (0.0, -4.0, 4.0)
"""Places from which the newest keyframe is described, m to its left."""
_COMPARED = 300
"""Largest number of places that are compared in full: those with the most similar key, the descriptor's mean
over the sectors."""
_LEAST_SHARE = 0.5
"""Least share of columns that both places fill; for a smaller share the distance increases."""


@dataclass(frozen=True)
class Likeness:
    """The similarity of the last keyframe's place to the places of n others."""

    index: NDArray[np.int64]
    """(n,) indices of the other keyframes."""
    distance: NDArray[np.float64]
    """(n,) distances of the descriptors: 0 for equal ones, 1 for ones with nothing in common."""
    turn: NDArray[np.float64]
    """(n,) rotation of the last keyframe about the world's z axis at which it is most similar, rad."""
    aside: NDArray[np.float64]
    """(n,) place to the left of the last keyframe from which it is most similar, m."""

    def among(self, chosen: NDArray[np.bool_]) -> "Likeness":
        """Return the rows of an (n,) mask."""
        return Likeness(self.index[chosen], self.distance[chosen], self.turn[chosen], self.aside[chosen])

    def T_target_source(self, row: int, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the last keyframe in another's frame, (4, 4) m, that the similarity implies.

        Args:
            row: row of this table.
            poses: (k, 4, 4) T_world_imu, m, with which the places were compared.
        """
        cos, sin = np.cos(self.turn[row]), np.sin(self.turn[row])
        target = poses[self.index[row]]
        turned = np.eye(4)
        turned[:3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ poses[-1, :3, :3]
        # the place to the side of the source coincides with the target
        turned[:3, 3] = target[:3, 3] - self.aside[row] * turned[:3, 1]
        return np.linalg.inv(target) @ turned


class DescribedPlaces:
    """The descriptors of all keyframes so far."""

    def __init__(self, rings: int, sectors: int, reach: float) -> None:
        """Begin without descriptors.

        Args:
            rings: number of rings of the polar grid.
            sectors: number of sectors of the polar grid.
            reach: radius of the polar grid, m.
        """
        self._shape, self._reach = (rings, sectors), reach
        # frequency first: a matrix product for each
        self._spectra = np.zeros((sectors // 2 + 1, 64, rings + 1), np.complex64)
        self._heading = np.zeros(64)
        self._count = 0
        self._newest = self._spectra[:, :0]

    def add(self, keyframe: Keyframe) -> None:
        """Add the descriptor of the next keyframe."""
        if self._count == self._spectra.shape[1]:
            self._spectra = np.concatenate([self._spectra, np.zeros_like(self._spectra)], axis=1)
            self._heading = np.concatenate([self._heading, np.zeros_like(self._heading)])
        left = keyframe.T_odom_imu[:3, 1]
        level = keyframe.points @ keyframe.T_odom_imu[:3, :3].T.astype(np.float32)
        images = [polar_image(level - aside * left, *self._shape, self._reach) for aside in _ASIDE]
        self._newest = _spectra(np.stack(images))
        self._spectra[:, self._count] = self._newest[:, 0]
        self._heading[self._count] = _headings(keyframe.T_odom_imu[None])[0]
        self._count += 1

    def compared(
        self, poses: NDArray[np.float64], index: NDArray[np.int64], heading_error: NDArray[np.float64]
    ) -> Likeness:
        """Return the similarity of the newest place to others.

        Args:
            poses: (k, 4, 4) T_world_imu of all keyframes, corrected so far, m.
            index: (m,) indices of the others.
            heading_error: (m,) largest error of the heading between the newest keyframe and each other, rad.
        """
        rings, sectors = self._shape
        # the zeroth frequency is the sum over the sectors
        keys, own = self._spectra[0, index, :rings].real, self._newest[0, :, :rings].real
        apart = np.min(np.sum((keys[:, None] - own) ** 2, axis=2), axis=1)
        nearest = np.sort(np.argsort(apart, kind="stable")[:_COMPARED])
        index, heading_error = index[nearest], heading_error[nearest]

        others = self._spectra[:, index]
        newest = self._newest.conj()
        alike = np.matmul(others[..., :rings], newest[..., :rings].transpose(0, 2, 1))
        both = others[..., rings:] * newest[..., rings:].transpose(0, 2, 1)
        # axes: the rotation, the other keyframe, and the place to the side
        cosines, columns = (irfft(spectrum, sectors, axis=0) for spectrum in (alike, both))
        distance = 1 - cosines / np.maximum(columns, _LEAST_SHARE * sectors)

        # rotations by corrections since the places were described
        since = _headings(poses[: self._count]) - self._heading[: self._count]
        turn = 2 * np.pi * np.arange(sectors)[:, None] / sectors + since[index] - since[-1]
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        # half a sector more, so that at least one rotation is left
        possible = np.abs(turn) <= heading_error + np.pi / sectors
        distance = np.where(possible[:, :, None], distance, np.inf).astype(np.float64)
        rows = np.arange(len(index))
        choices = distance.transpose(1, 0, 2).reshape(len(index), sectors * len(_ASIDE))
        best = np.argmin(choices, axis=1)
        sector, aside = best // len(_ASIDE), best % len(_ASIDE)
        return Likeness(index, distance[sector, rows, aside], turn[sector, rows], np.array(_ASIDE)[aside])


def polar_image(points: _Array, rings: int, sectors: int, reach: float) -> _Array:
    """Return the height of the highest point in each cell, (rings, sectors) m, from near the ground.

    Args:
        points: (n, 3) m, from the sensor, z up.
        rings: number of rings of equal width.
        sectors: number of sectors, counterclockwise from x.
        reach: outer radius of the outermost ring, m.
    """
    away = np.hypot(points[:, 0], points[:, 1])
    points, away = points[away < reach], away[away < reach]
    share = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) % 1.0
    sector = np.minimum((share * sectors).astype(np.int64), sectors - 1)
    image = np.zeros((rings, sectors), np.float32)
    height = np.maximum(points[:, 2] + _BELOW, 0).astype(np.float32)
    np.maximum.at(image, ((away / reach * rings).astype(np.int64), sector), height)
    return image


def _spectra(images: _Array) -> NDArray[np.complex64]:
    """Return (frequencies, m, rings + 1) Fourier transforms, along sectors, of (m, rings, sectors) images.

    Columns have unit length, so products are cosines. The extra ring is 1 for columns that are not empty.
    """
    length = np.linalg.norm(images, axis=1, keepdims=True)
    seen = length > 0
    columns = np.concatenate([images / np.where(seen, length, 1), seen], axis=1)
    return rfft(columns.astype(np.float32), axis=2).transpose(2, 0, 1).astype(np.complex64)


def _headings(poses: _Array) -> _Array:
    return np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
