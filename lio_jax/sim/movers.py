"""Boxes that drive round and round on closed paths, so that a recording may be of any length."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lio_jax.sim.primitives import Boxes


class Movers(eqx.Module):
    """Bodies on closed paths, each made of a few upright boxes."""

    path: Float[Array, "m k 3"]
    """Where each body is at equal steps of its period, world frame, m."""
    yaw: Float[Array, "m k"]
    """Its heading there, rad."""
    period: Float[Array, " m"]
    """Duration of a lap, s."""
    body: Int[Array, " n"]
    """Which body each box belongs to."""
    boxes: Boxes
    """In the body's own frame (x forward, z up)."""


class MovingBoxes(eqx.Module):
    """Boxes at an instant and their velocity: within a sweep they move uniformly, without turning."""

    boxes: Boxes
    """At time zero."""
    velocity: Float[Array, "n 3"]
    """m/s."""

    @property
    def reflectivity(self) -> Float[Array, " n"]:
        """Of the boxes, 0 to 1."""
        return self.boxes.reflectivity

    def moved(self, by: Float[Array, "3"]) -> "MovingBoxes":
        """Return them displaced."""
        return MovingBoxes(self.boxes.moved(by), self.velocity)


def moving_boxes(movers: Movers, time: Float[Array, ""]) -> MovingBoxes:
    """Return where the boxes are at ``time`` (s) and how fast they move; between path points in a line."""
    bodies, steps = movers.yaw.shape
    passed = jnp.mod(time / movers.period, 1.0) * steps
    # a share that rounds up to a whole lap is the lap's start
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
