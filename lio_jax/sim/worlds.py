"""Worlds: fixed and moving shapes, and the route through them."""

from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import NDArray

from lio_jax.sim.primitives import Boxes, Cylinders, Grounds, Panes, Planes, Spheres, TiltedBoxes


class Movers(eqx.Module):
    """Bodies on closed paths; each consists of a few upright boxes."""

    path: Float[Array, "m k 3"]
    """Position of each body at equal steps of its period, world frame, m."""
    yaw: Float[Array, "m k"]
    """Heading of each body at those positions, rad."""
    period: Float[Array, " m"]
    """Duration of a lap, s."""
    body: Int[Array, " n"]
    """Which body each box belongs to."""
    boxes: Boxes
    """Boxes in the body's own frame (x forward, z up)."""


class MovingBoxes(eqx.Module):
    """Boxes at an instant and their velocity: within a sweep they move uniformly and do not turn."""

    boxes: Boxes
    """Boxes at the instant."""
    velocity: Float[Array, "n 3"]
    """Velocity of each box, m/s."""

    @property
    def reflectivity(self) -> Float[Array, " n"]:
        """Reflectivity of the boxes, 0 to 1."""
        return self.boxes.reflectivity

    def moved(self, by: Float[Array, "3"]) -> "MovingBoxes":
        """Return the boxes displaced by ``by`` (m)."""
        return MovingBoxes(self.boxes.moved(by), self.velocity)


def moving_boxes(movers: Movers, time: Float[Array, ""]) -> MovingBoxes:
    """Return the boxes at ``time`` (s) and their velocities, on straight lines between path points."""
    bodies, steps = movers.yaw.shape
    passed = jnp.mod(time / movers.period, 1.0) * steps
    # a share that rounds up to a whole lap is the start of the lap
    now = jnp.floor(passed).astype(jnp.int32) % steps
    ahead = (now + 1) % steps
    share = (passed - jnp.floor(passed))[:, None]
    row = jnp.arange(bodies)
    here, there = movers.path[row, now], movers.path[row, ahead]
    turn = movers.yaw[row, ahead] - movers.yaw[row, now]
    yaw = movers.yaw[row, now] + share[:, 0] * jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    position = here + share * (there - here)
    velocity = (there - here) * (steps / movers.period)[:, None]
    body, boxes = movers.body, movers.boxes
    cos, sin = jnp.cos(yaw)[body], jnp.sin(yaw)[body]
    x, y, z = boxes.center.T
    offset = jnp.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)
    placed = Boxes(position[body] + offset, boxes.half_size, yaw[body] + boxes.yaw, boxes.reflectivity)
    return MovingBoxes(placed, velocity[body])


class Solids(eqx.Module):
    """All solids at rest; they may overlap, because only the first surface that a ray meets counts."""

    planes: Planes
    grounds: Grounds
    boxes: Boxes
    tilted: TiltedBoxes
    cylinders: Cylinders
    spheres: Spheres


class World(eqx.Module):
    """All that a ray can meet, in the world frame."""

    solids: Solids
    movers: Movers
    glass: Panes | None = None
    """Panes of glass; None: there are none."""


class Part(eqx.Module):
    """The solids near a position at an instant, in a frame with that position as origin, ready for rays."""

    solids: Solids
    moving: MovingBoxes
    glass: Panes | None = None


class Counts(NamedTuple):
    """Number of solids to keep of each kind that is culled."""

    boxes: int | Int[Array, ""]
    tilted: int | Int[Array, ""]
    cylinders: int | Int[Array, ""]
    spheres: int | Int[Array, ""]


_Rows = TypeVar("_Rows", Boxes, TiltedBoxes, Cylinders, Spheres)


def nearest_part(
    world: World, position: Float[Array, "3"], time: Float[Array, ""], counts: Counts
) -> tuple[Part, Float[Array, ""]]:
    """Return planes, grounds, movers and the nearest other solids in a frame with ``position`` as origin.

    Float32 separates solids best near the origin, and casting is cheap without the far solids.

    Args:
        world: all solids and movers.
        position: (3,) m, world frame; rays are stated relative to it.
        time: where the movers are placed, s from the recording's start.
        counts: numbers of solids to keep, static.

    Returns:
        The part, and the radius (m) around ``position`` within which no solid is left out.
    """
    gaps = _gaps(world, position)
    solids = world.solids
    boxes, box_reach = _nearest_rows(solids.boxes, gaps[0], int(counts.boxes))
    tilted, tilted_reach = _nearest_rows(solids.tilted, gaps[1], int(counts.tilted))
    cylinders, cylinder_reach = _nearest_rows(solids.cylinders, gaps[2], int(counts.cylinders))
    spheres, sphere_reach = _nearest_rows(solids.spheres, gaps[3], int(counts.spheres))
    part = Part(
        Solids(
            solids.planes.moved(-position),
            solids.grounds.moved(-position),
            boxes.moved(-position),
            tilted.moved(-position),
            cylinders.moved(-position),
            spheres.moved(-position),
        ),
        moving_boxes(world.movers, time).moved(-position),
        None if world.glass is None else world.glass.moved(-position),
    )
    reach = jnp.min(jnp.stack([box_reach, tilted_reach, cylinder_reach, sphere_reach]))
    return part, reach


def counts_within(world: World, position: Float[Array, "3"], radius: float | Float[Array, ""]) -> Counts:
    """Count the solids of each culled kind that reach into the horizontal circle of ``radius`` m."""
    return Counts(*(jnp.sum(gap < radius) for gap in _gaps(world, position)))


def counts_along(world: World, positions: Float[Array, "n 3"], radius: float) -> Counts:
    """Return the largest count of each kind within ``radius`` m of any position, as plain integers."""
    counts = _counts_along(world, positions, jnp.asarray(radius, positions.dtype))
    return Counts(*(int(count.max()) for count in counts))


@jax.jit
def _counts_along(world: World, positions: Float[Array, "n 3"], radius: Float[Array, ""]) -> Counts:
    return jax.vmap(lambda position: counts_within(world, position, radius))(positions)


def _gaps(world: World, position: Float[Array, "3"]) -> tuple[Float[Array, " n"], ...]:
    """Return horizontal distances (m) from ``position`` to each culled kind, never above the true ones."""
    solids = world.solids

    def level(centers: Float[Array, "n 3"]) -> Float[Array, " n"]:
        return jnp.linalg.norm(centers[:, :2] - position[:2], axis=1)

    return (
        level(solids.boxes.center) - jnp.linalg.norm(solids.boxes.half_size[:, :2], axis=1),
        level(solids.tilted.center) - jnp.linalg.norm(solids.tilted.half_size, axis=1),
        level(solids.cylinders.base) - solids.cylinders.radius,
        level(solids.spheres.center) - solids.spheres.radius,
    )


def _nearest_rows(rows: _Rows, gap: Float[Array, " n"], count: int) -> tuple[_Rows, Float[Array, ""]]:
    order = jnp.argsort(gap)
    reach = gap[order[count]] if count < gap.shape[0] else jnp.array(jnp.inf, gap.dtype)
    return jax.tree.map(lambda leaf: leaf[order[:count]], rows), reach


Dynamics = Literal["car", "handheld", "drone"]
"""Kind of body: it sets sway, vibration and how the body looks around."""


@dataclass(frozen=True)
class Route:
    """The path of the body (IMU) frame: a polyline whose corners are rounded."""

    points: NDArray[np.float64]
    """Vertices in driving order, (n, 3) m, world frame; the route starts at the first."""
    closed: bool
    """Whether the last vertex is joined to the first, for laps without end.

    An open route is driven to its end and back again; on the way back the body faces the same way.
    """
    radius: float
    """Radius of the rounded corners, m."""
    speed: float
    """Speed on straights, m/s."""
    dynamics: Dynamics


@dataclass(frozen=True)
class Scene:
    """A world and a route that stays clear of its surfaces."""

    world: World
    route: Route
