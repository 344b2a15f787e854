"""A single room with a pillar and a ball: every distance has a closed form."""

import numpy as np

from lio_jax.sim.assembly import assembled, upright
from lio_jax.sim.worlds import Route, Scene

SIZE = np.array([12.0, 8.0, 3.5])
"""Size of the room along x, y and z, m; the builder's frame has its origin at the floor's centre."""
PILLAR = (0.0, 0.0, 0.4)
"""Position x, y and radius of the pillar, m; it reaches from floor to ceiling."""
BALL = (4.9, 2.9, 0.6, 0.5)
"""Centre x, y, z and radius of the ball, m."""
START = np.array([-1.0, -2.2, 1.4])
"""Start of the route, m."""


def room(seed: int) -> Scene:
    """Return the room and a walk around its pillar; ``seed`` changes the reflectivities only."""
    reflectivity = np.random.default_rng(seed).uniform(0.2, 0.9, 3)
    half = SIZE / 2
    world = assembled(
        START,
        boxes=upright([-half[0], -half[1], 0], [half[0], half[1], SIZE[2]], reflectivity[0]),
        cylinders=[[PILLAR[0], PILLAR[1], 0, PILLAR[2], SIZE[2], reflectivity[1]]],
        spheres=[[*BALL, reflectivity[2]]],
    )
    points = np.array(
        [[-1.0, -2.2, 1.4], [3.4, -2.2, 1.5], [3.4, 2.2, 1.3], [-3.6, 2.4, 1.45], [-4.0, -2.2, 1.4]]
    )
    return Scene(world, Route(points - START, closed=True, radius=0.8, speed=1.1, dynamics="handheld"))
