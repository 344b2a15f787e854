"""Routes for the tests: one of each kind of body, with corners, a climb, and both ways of ending."""

import numpy as np

from lio_jax.sim.worlds import Route

LAP = Route(
    points=np.array(
        [
            [0, 0, 0],
            [60, 0, 0],
            [60, 50, 0],
            [20, 50, 2],
            [-40, 50, 2],
            [-40, 90, 2],
            [-80, 90, 2],
            [-80, 0, 0],
        ],
        float,
    ),
    closed=True,
    radius=9.0,
    speed=6.16,
    dynamics="car",
)
"""Right and left turns, a ramp up and a ramp down."""

_CORRIDOR = np.array([[0, 0, 0], [6, 0, 0], [6, 5, 0], [9, 8, 1.5], [14, 8, 1.5]], float)
WALK = Route(points=_CORRIDOR, closed=False, radius=0.8, speed=1.2, dynamics="handheld")
FLIGHT = Route(points=4 * _CORRIDOR, closed=False, radius=4.0, speed=3.0, dynamics="drone")
