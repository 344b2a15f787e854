"""The centre line of a street with one bend, the height of its ground, and the triangles of all it holds."""

import math
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

BEND_START_M, BEND_LENGTH_M = 60.0, 40.0
"""Part of the centre line on which the heading turns by 90 deg to the left."""
_FIRST_M, _LAST_M, _STEP_M = -70.0, 260.0, 0.05
_CLEAR_M = 7.5
"""Smallest distance of a building from the centre line."""
_CELL_M = 2.0
_MARGIN_M = 90.0

Floats = NDArray[np.float64]


def smooth_step(x: Floats) -> Floats:
    """Return 0 below 0, 1 above 1, and a polynomial with two continuous derivatives between them."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 + x * (6 * x - 15))


class CentreLine:
    """A plane curve by its arc length: straight along +x, a bend to the left, straight along +y."""

    def __init__(self) -> None:
        arc = np.arange(_FIRST_M, _LAST_M + _STEP_M, _STEP_M)
        heading = self.heading(arc)
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        steps = 0.5 * _STEP_M * (tangent[1:] + tangent[:-1])
        points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        points -= points[np.argmin(np.abs(arc))]
        self._curve = CubicSpline(arc, points)

    @staticmethod
    def heading(arc: Floats) -> Floats:
        """Return the angle of the tangent from +x, rad."""
        return 0.5 * np.pi * smooth_step((np.asarray(arc) - BEND_START_M) / BEND_LENGTH_M)

    def point(self, arc: Floats, left: Floats | float = 0.0) -> Floats:
        """Return (..., 2) points ``left`` m to the left of the centre line, at arc lengths in m."""
        heading = self.heading(arc)
        normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        return np.asarray(self._curve(arc)) + np.asarray(left)[..., None] * normal


@dataclass(frozen=True)
class Ground:
    """A height field: a sum of plane waves with slopes of a few per cent."""

    wave: Floats
    """(n, 2) wave vectors, rad/m."""
    amplitude: Floats
    """(n,) m."""
    phase: Floats
    """(n,) rad."""

    @staticmethod
    def drawn(rng: np.random.Generator) -> "Ground":
        """Return a ground with four random waves of 50 to 120 m."""
        length, angle = rng.uniform(50, 120, 4), rng.uniform(0, 2 * np.pi, 4)
        wave = (2 * np.pi / length)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return Ground(wave, rng.uniform(0.1, 0.4, 4), rng.uniform(0, 2 * np.pi, 4))

    def height(self, points: Floats) -> Floats:
        """Return the height at (..., 2) points, m."""
        return np.sin(points @ self.wave.T + self.phase) @ self.amplitude

    def slope(self, points: Floats) -> Floats:
        """Return the derivatives of the height by x and y, (..., 2)."""
        return (np.cos(points @ self.wave.T + self.phase) * self.amplitude) @ self.wave


def street(seed: int, line: CentreLine, ground: Ground) -> trimesh.Trimesh:
    """Return one mesh with the ground, buildings, awnings, poles, trees and parked cars, m.

    Args:
        seed: seed of what stands where.
        line: the street's centre line.
        ground: height of the ground.
    """
    rng = np.random.default_rng([seed, 1])
    parts = [_ground_mesh(line, ground)]
    for side in (-1.0, 1.0):
        parts += _buildings(rng, line, ground, side)
        parts += _poles(rng, line, ground, side)
        parts += _trees(rng, line, ground, side)
        parts += _cars(rng, line, ground, side)
    return trimesh.util.concatenate(parts)


def _ground_mesh(line: CentreLine, ground: Ground) -> trimesh.Trimesh:
    points = line.point(np.arange(_FIRST_M, _LAST_M, 1.0))
    low, high = points.min(0) - _MARGIN_M, points.max(0) + _MARGIN_M
    xs, ys = (np.arange(a, b, _CELL_M) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    vertices = np.column_stack([grid, ground.height(grid)])
    corner = (np.arange(len(xs) - 1)[:, None] * len(ys) + np.arange(len(ys) - 1)).ravel()
    beside = corner + len(ys)
    faces = np.concatenate(
        [np.stack([corner, beside, beside + 1], 1), np.stack([corner, beside + 1, corner + 1], 1)]
    )
    return trimesh.Trimesh(vertices, faces, process=False)


def _placed(mesh: trimesh.Trimesh, point: Floats, height: float, yaw: float) -> trimesh.Trimesh:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    pose[:3, 3] = [point[0], point[1], height]
    return mesh.apply_transform(pose)


def _buildings(
    rng: np.random.Generator, line: CentreLine, ground: Ground, side: float
) -> list[trimesh.Trimesh]:
    parts: list[trimesh.Trimesh] = []
    driven = line.point(np.arange(_FIRST_M, _LAST_M, 1.0))
    arc = _FIRST_M
    while arc < _LAST_M:
        width, depth, height = rng.uniform(7, 18), rng.uniform(7, 12), rng.uniform(3, 11)
        at = arc + width / 2
        yaw = float(line.heading(at)) + math.radians(rng.normal(0, 3))
        if rng.random() < 0.25:
            yaw += math.radians(rng.uniform(12, 35)) * rng.choice([-1, 1])
        point = line.point(at, side * (9.5 + depth / 2 + rng.uniform(0, 4)))
        gable, awning, bay = rng.random(3) < [0.5, 0.4, 0.5]
        slope = rng.uniform(0.4, 0.8)
        arc += width + rng.uniform(1, 7)
        if not _is_clear(driven, point, yaw, 0.5 * np.array([width, depth])):
            continue
        foot = float(ground.height(point)) - 1.0
        house = [_box([width, depth, height + 1], [0, 0, 0.5 * (height + 1)])]
        if gable:
            house.append(_gable(width, depth, height + 1, 0.5 * depth * slope))
        front = -side * 0.5 * depth
        if awning:
            tilt = Rotation.from_euler("x", side * 0.45).as_matrix()
            roof = _box([0.6 * width, 1.6, 0.08], [0, 0, 0])
            roof.apply_transform(_rigid(tilt, [0, front - side * 0.7, 3.6]))
            house.append(roof)
        if bay:
            house.append(_box([0.25 * width, 1.2, 0.8 * height], [0.25 * width, front, 0.4 * height + 1]))
        parts.append(_placed(trimesh.util.concatenate(house), point, foot, yaw))
    return parts


def _poles(rng: np.random.Generator, line: CentreLine, ground: Ground, side: float) -> list[trimesh.Trimesh]:
    parts = []
    for arc in np.arange(_FIRST_M, _LAST_M, 17.0) + rng.uniform(0, 17):
        point = line.point(arc, side * rng.uniform(6.0, 6.6))
        tall = rng.uniform(4, 8)
        pole = trimesh.creation.cylinder(rng.uniform(0.06, 0.18), tall, sections=16)
        parts.append(_placed(pole, point, float(ground.height(point)) + 0.5 * tall - 0.3, 0.0))
    return parts


def _trees(rng: np.random.Generator, line: CentreLine, ground: Ground, side: float) -> list[trimesh.Trimesh]:
    parts = []
    for arc in np.arange(_FIRST_M, _LAST_M, 23.0) + rng.uniform(0, 23):
        point = line.point(arc, side * rng.uniform(6.8, 8.0))
        foot, trunk = float(ground.height(point)) - 0.3, rng.uniform(2.2, 3.2)
        stem = trimesh.creation.cylinder(rng.uniform(0.12, 0.3), trunk, sections=12)
        parts.append(_placed(stem, point, foot + 0.5 * trunk, 0.0))
        if rng.random() < 0.5:
            crown = trimesh.creation.icosphere(2, rng.uniform(0.9, 1.5))
            parts.append(_placed(crown, point, foot + trunk + 0.8, 0.0))
        else:
            crown = trimesh.creation.cone(rng.uniform(0.9, 1.5), rng.uniform(3, 5), sections=20)
            parts.append(_placed(crown, point, foot + trunk - 0.6, 0.0))
    return parts


def _cars(rng: np.random.Generator, line: CentreLine, ground: Ground, side: float) -> list[trimesh.Trimesh]:
    parts = []
    for arc in np.arange(_FIRST_M, _LAST_M, 8.0):
        at = arc + rng.uniform(0, 2)
        if rng.random() < 0.45:
            continue
        point = line.point(at, side * rng.uniform(4.6, 5.2))
        yaw = float(line.heading(at)) + math.radians(rng.normal(0, 2))
        if rng.random() < 0.2:
            car = [_box([4.8, 1.9, 2.0], [0, 0, 1.3])]
        else:
            cabin = trimesh.creation.icosphere(3)
            cabin.apply_scale([1.5, 0.8, 0.65]).apply_translation([-0.2, 0, 0.95])
            car = [_box([4.3, 1.8, 0.65], [0, 0, 0.6]), cabin]
        parts.append(_placed(trimesh.util.concatenate(car), point, float(ground.height(point)), yaw))
    return parts


def _box(size: list[float], centre: list[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(centre)


def _gable(width: float, depth: float, foot: float, rise: float) -> trimesh.Trimesh:
    """Return a prism whose ridge runs along the house, with eaves of 0.4 m."""
    x, y = 0.5 * width, 0.5 * depth + 0.4
    corners = [[sx * x, sy * y, foot] for sx in (-1, 1) for sy in (-1, 1)]
    return trimesh.Trimesh([*corners, [-x, 0, foot + rise], [x, 0, foot + rise]]).convex_hull


def _rigid(rotation: Floats, translation: list[float]) -> Floats:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def _is_clear(driven: Floats, point: Floats, yaw: float, half: Floats) -> bool:
    """Return whether a turned rectangle is farther from the centre line than buildings have to be."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    local = np.abs((driven - point) @ np.array([[cosine, -sine], [sine, cosine]]))
    return bool(np.linalg.norm(np.maximum(local - half, 0), axis=1).min() > _CLEAR_M)
