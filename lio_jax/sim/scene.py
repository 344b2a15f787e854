"""What a procedural builder returns: a world and the route through it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.worlds import World

Dynamics = Literal["car", "handheld", "drone"]
"""How a body moves along its route: sets sway, vibration and how it looks around."""


@dataclass(frozen=True)
class Route:
    """The path of the body (IMU) frame, as a polyline whose corners are rounded."""

    points: NDArray[np.float64]
    """(n, 3) vertices in driving order, world frame, m; the route starts at the first."""
    closed: bool
    """Whether the last vertex is joined to the first, to be driven lap after lap; an open route is driven to
    its end and back again, facing the same way."""
    radius: float
    """Of the rounded corners, m."""
    speed: float
    """On straights, m/s."""
    dynamics: Dynamics


@dataclass(frozen=True)
class Scene:
    """A world and a route that stays clear of its surfaces."""

    world: World
    route: Route
