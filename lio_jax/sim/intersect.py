"""Where rays meet the shapes of a world, and the normal of the surface there."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.sim.primitives import Boxes, Cylinders, Grounds, Planes, Spheres, TiltedBoxes
from lio_jax.sim.worlds import MovingBoxes

TINY = 1e-12
"""Replaces a zero component of a direction: 1/TINY stays finite in float32."""

_GROUND_STEPS = 20
"""Number of steps: with 16, one ray in 15,000 had not reached a ground at 130 m; with 20, every ray had."""

_GROUND_END = 300.0
"""Beyond this distance no ray meets a ground, m."""


class Rays(NamedTuple):
    """Origins (m) and unit directions: one array for each coordinate, the layout that vectorises best."""

    x: Float[Array, "*n"]
    y: Float[Array, "*n"]
    z: Float[Array, "*n"]
    dx: Float[Array, "*n"]
    dy: Float[Array, "*n"]
    dz: Float[Array, "*n"]
    time: Float[Array, "*n"]
    """Time since the instant at which the moving boxes were placed, s."""


def plane_distance(plane: Any, rays: Rays) -> Float[Array, "*n"]:
    """Return the distance to one plane (a row of Planes)."""
    point, normal = plane.point, plane.normal
    closing = rays.dx * normal[0] + rays.dy * normal[1] + rays.dz * normal[2]
    gap = (point[0] - rays.x) * normal[0] + (point[1] - rays.y) * normal[1] + (point[2] - rays.z) * normal[2]
    distance = gap / _away_from_zero(closing)
    return jnp.where((distance > 0) & (jnp.abs(closing) > TINY), distance, jnp.inf)


def ground_distance(ground: Any, rays: Rays) -> Float[Array, "*n"]:
    """Return the distance to one height field (a row of Grounds).

    With F the ray's height above ground and c >= |F''| along it, the ray meets nothing before
    F + F' s - c s^2 / 2 falls to zero. Steps of that s never pass the first crossing, and they converge to it
    quadratically. A ray that only grazes the ground may use up its steps; it counts as a miss.
    """
    waves = [
        (
            amplitude,
            wave[0] * rays.x + wave[1] * rays.y + phase,
            wave[0] * rays.dx + wave[1] * rays.dy,
        )
        for amplitude, wave, phase in zip(ground.amplitude, ground.wave, ground.phase, strict=True)
    ]
    bend = sum((amplitude * slope**2 for amplitude, _, slope in waves), jnp.zeros_like(rays.x))

    def above(distance: Array) -> tuple[Array, Array]:
        gap, rate = rays.z + distance * rays.dz - ground.height, rays.dz
        for amplitude, start, slope in waves:
            sin, cos = _sin_cos(start + slope * distance)
            gap, rate = gap - amplitude * sin, rate - amplitude * slope * cos
        return gap, rate

    begin = jnp.zeros_like(rays.x)
    side = jnp.where(above(begin)[0] < 0, -1.0, 1.0).astype(begin.dtype)

    def advance(_: Array, distance: Array) -> Array:
        gap, rate = above(distance)
        gap, rate = jnp.maximum(side * gap, 0), side * rate
        root = jnp.sqrt(rate**2 + 2 * bend * gap)
        falling = 2 * gap / jnp.maximum(root - rate, TINY)
        rising = (rate + root) / jnp.maximum(bend, TINY)
        return jnp.minimum(distance + jnp.where(rate < 0, falling, rising), _GROUND_END)

    distance = jax.lax.fori_loop(0, _GROUND_STEPS, advance, begin)
    # about ten times the rounding error of a coordinate of that size
    tolerance = 10 * jnp.finfo(begin.dtype).eps * (10 + distance)
    reached = (jnp.abs(above(distance)[0]) < tolerance) & (distance > 0) & (distance < _GROUND_END)
    return jnp.where(reached, distance, jnp.inf)


def box_distance(box: Any, rays: Rays) -> Float[Array, "*n"]:
    """Return the distance to one upright box (a row of Boxes); slab method."""
    cos, sin = jnp.cos(box.yaw), jnp.sin(box.yaw)
    east, north = rays.x - box.center[0], rays.y - box.center[1]
    slabs = (
        _slab(cos * east + sin * north, cos * rays.dx + sin * rays.dy, box.half_size[0]),
        _slab(cos * north - sin * east, cos * rays.dy - sin * rays.dx, box.half_size[1]),
        _slab(rays.z - box.center[2], rays.dz, box.half_size[2]),
    )
    return _first_of_interval(*slabs)


def tilted_distance(box: Any, rays: Rays) -> Float[Array, "*n"]:
    """Return the distance to one box in any attitude (a row of TiltedBoxes); slab method."""
    east, north, up = rays.x - box.center[0], rays.y - box.center[1], rays.z - box.center[2]
    slabs = (
        _slab(
            axis[0] * east + axis[1] * north + axis[2] * up,
            axis[0] * rays.dx + axis[1] * rays.dy + axis[2] * rays.dz,
            box.half_size[number],
        )
        for number, axis in enumerate(box.rotation.T)
    )
    return _first_of_interval(*slabs)


def moving_distance(moving: Any, rays: Rays) -> Float[Array, "*n"]:
    """Return the distance to one moving box (a row of MovingBoxes) at its place when each ray is sent."""
    return box_distance(
        moving.boxes,
        rays._replace(
            x=rays.x - moving.velocity[0] * rays.time,
            y=rays.y - moving.velocity[1] * rays.time,
            z=rays.z - moving.velocity[2] * rays.time,
        ),
    )


def cylinder_distance(cylinder: Any, rays: Rays) -> Float[Array, "*n"]:
    """Return the distance to one solid cylinder (a row of Cylinders).

    The discriminant comes from the ray's closest approach to the axis, a r^2 - cross^2: the textbook
    b^2 - ac loses thin poles to cancellation in float32.
    """
    east, north = rays.x - cylinder.base[0], rays.y - cylinder.base[1]
    level = rays.dx**2 + rays.dy**2
    a = jnp.maximum(level, TINY)
    b = east * rays.dx + north * rays.dy
    cross = east * rays.dy - north * rays.dx
    discriminant = a * cylinder.radius**2 - cross**2
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    missed = jnp.where(level < TINY, east**2 + north**2 > cylinder.radius**2, discriminant < 0)
    wall = (jnp.where(missed, jnp.inf, (-b - root) / a), jnp.where(missed, -jnp.inf, (-b + root) / a))
    half = cylinder.height / 2
    return _first_of_interval(wall, _slab(rays.z - cylinder.base[2] - half, rays.dz, half))


def sphere_distance(sphere: Any, rays: Rays) -> Float[Array, "*n"]:
    """Return the distance to one ball (a row of Spheres), by the ray's closest approach to its centre."""
    x, y, z = sphere.center[0] - rays.x, sphere.center[1] - rays.y, sphere.center[2] - rays.z
    along = x * rays.dx + y * rays.dy + z * rays.dz
    aside = (x - along * rays.dx) ** 2 + (y - along * rays.dy) ** 2 + (z - along * rays.dz) ** 2
    discriminant = sphere.radius**2 - aside
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    distance = jnp.where(along > root, along - root, along + root)
    return jnp.where((discriminant >= 0) & (distance > 0), distance, jnp.inf)


def _away_from_zero(value: Float[Array, "*n"]) -> Float[Array, "*n"]:
    return jnp.where(jnp.abs(value) < TINY, TINY, value)


def _sin_cos(angle: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Return sine and cosine to 2e-14 for angles up to some tens of rad, on a CPU 10 times as fast as jnp."""
    quarter = jnp.round(angle * (2 / jnp.pi))
    # pi/2 in three parts (Cody and Waite): small multiples of the first two are exact in float32
    rest = ((angle - quarter * 1.5703125) - quarter * 4.8351287841796875e-4) - quarter * 3.139164786504813e-7
    square = rest**2
    sin, cos = jnp.ones_like(square), jnp.ones_like(square)
    for power in range(14, 0, -2):
        sin = 1 - square * sin / (power * (power + 1))
        cos = 1 - square * cos / (power * (power - 1))
    sin = rest * sin
    turn = quarter - 4 * jnp.floor(quarter / 4)
    odd = (turn == 1) | (turn == 3)
    sin, cos = jnp.where(odd, cos, sin), jnp.where(odd, sin, cos)
    return jnp.where(turn >= 2, -sin, sin), jnp.where((turn == 1) | (turn == 2), -cos, cos)


def _slab(
    offset: Float[Array, "*n"], direction: Float[Array, "*n"], half: Float[Array, ""]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    inverse = 1 / _away_from_zero(direction)
    middle, reach = -offset * inverse, half * jnp.abs(inverse)
    return middle - reach, middle + reach


def _first_of_interval(*intervals: tuple[Float[Array, "*n"], Float[Array, "*n"]]) -> Float[Array, "*n"]:
    enter, leave = intervals[0]
    for start, end in intervals[1:]:
        enter, leave = jnp.maximum(enter, start), jnp.minimum(leave, end)
    distance = jnp.where(enter > 0, enter, leave)
    return jnp.where((enter <= leave) & (distance > 0), distance, jnp.inf)


def plane_normal(planes: Planes, point: Float[Array, "n 3"], time: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Return the planes' normals, which are the same at every point."""
    return planes.normal


def ground_normal(
    grounds: Grounds, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the upward normals of the grounds at the points."""
    angle = grounds.wave[..., 0] * point[:, :1] + grounds.wave[..., 1] * point[:, 1:2] + grounds.phase
    slope = jnp.sum((grounds.amplitude * jnp.cos(angle))[..., None] * grounds.wave, axis=1)
    upward = jnp.concatenate([-slope, jnp.ones_like(slope[:, :1])], axis=1)
    return upward / jnp.linalg.norm(upward, axis=1, keepdims=True)


def box_normal(boxes: Boxes, point: Float[Array, "n 3"], time: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Return the outward normals of the faces nearest to the points."""
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    east, north, up = (point - boxes.center).T
    local = jnp.stack([cos * east + sin * north, cos * north - sin * east, up], axis=1)
    x, y, z = _face_normal(local, boxes.half_size).T
    return jnp.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)


def tilted_normal(
    boxes: TiltedBoxes, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the outward normals of the faces nearest to the points."""
    offset = point - boxes.center
    local = jnp.sum(boxes.rotation * offset[:, :, None], axis=1)
    return jnp.sum(boxes.rotation * _face_normal(local, boxes.half_size)[:, None, :], axis=2)


def moving_normal(
    moving: MovingBoxes, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the outward normals of the faces nearest to the points when they were met."""
    return box_normal(moving.boxes, point - moving.velocity * time[:, None], time)


def cylinder_normal(
    cylinders: Cylinders, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the outward normals of the side or of a cap, of the surface that is nearer to the point."""
    offset = point - cylinders.base
    radial = offset.at[:, 2].set(0)
    length = jnp.linalg.norm(radial, axis=1)
    above = offset[:, 2] - cylinders.height / 2
    on_wall = jnp.abs(cylinders.radius - length) < cylinders.height / 2 - jnp.abs(above)
    cap = jnp.zeros_like(offset).at[:, 2].set(jnp.sign(above))
    return jnp.where(on_wall[:, None], radial / jnp.maximum(length, TINY)[:, None], cap)


def sphere_normal(
    spheres: Spheres, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the outward normals of the balls at the points."""
    outward = point - spheres.center
    return outward / jnp.maximum(jnp.linalg.norm(outward, axis=1, keepdims=True), TINY)


def _face_normal(local: Float[Array, "n 3"], half_size: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    face = jnp.argmin(half_size - jnp.abs(local), axis=1)
    return jnp.sign(local) * jax.nn.one_hot(face, 3, dtype=local.dtype)
