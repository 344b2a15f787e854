"""A long smooth road tunnel between two built-up portals.

Every cross-section is the same between the lining's first and last 60 m, which have niches and lamps. There
the position along the axis is not observable for a sensor with a range of less than about 100 m.
"""

import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.assembly import assembled, draws, upright
from lio_jax.sim.worlds import Route, Scene

LENGTH = 560.0
"""Length from portal to portal, m; in the builder's frame the tunnel runs along +x from 0, with y = 0."""
FURNISHED = 60.0
"""Length behind each portal that has niches and lamps, m."""
_APPROACH = 70.0
"""Length of open road before each portal, m."""
_HALF_WIDTH, _HEIGHT, _CHAMFER = 5.0, 6.5, 1.6
_LANE = -1.75
_BODY_HEIGHT = 1.6
_CONCRETE, _ASPHALT = 0.4, 0.15


def tunnel(seed: int) -> Scene:
    """Return the tunnel and a car's way through it; ``seed`` changes the surroundings of the portals."""
    rng = np.random.default_rng(seed)
    start = np.array([-_APPROACH + 10, _LANE, _BODY_HEIGHT])
    boxes, cylinders, spheres = _lining(), np.zeros((0, 6)), np.zeros((0, 5))
    for portal in (0, 1):
        built, poles, crowns = _surroundings(rng)
        if portal == 1:
            # turned by half a turn, so that it faces the other way
            center = [LENGTH, 0.0]
            built[:, :2], poles[:, :2], crowns[:, :2] = (
                center - rows[:, :2] for rows in (built, poles, crowns)
            )
        boxes = np.concatenate([boxes, built])
        cylinders, spheres = np.concatenate([cylinders, poles]), np.concatenate([spheres, crowns])
    world = assembled(
        start,
        planes=[[0, 0, 0, 0, 0, 1, _ASPHALT]],
        boxes=boxes,
        tilted=_chamfers(),
        cylinders=cylinders,
        spheres=spheres,
    )
    points = np.array([start, [LENGTH + _APPROACH - 10, _LANE, _BODY_HEIGHT]])
    return Scene(world, Route(points - start, closed=False, radius=30.0, speed=12.0, dynamics="car"))


def _lining() -> NDArray[np.float64]:
    inner, outer, top = _HALF_WIDTH, _HALF_WIDTH + 1, _HEIGHT + 1
    return np.concatenate(
        [
            upright([0, inner, -0.5], [LENGTH, outer, top], _CONCRETE),
            upright([0, -outer, -0.5], [LENGTH, -inner, top], _CONCRETE),
            upright([0, -outer, _HEIGHT], [LENGTH, outer, top], _CONCRETE),
        ]
    )


def _chamfers() -> NDArray[np.float64]:
    """Return the slanted edges between walls and ceiling."""
    half = np.array([LENGTH / 2, _CHAMFER, _CHAMFER / np.sqrt(2)])
    rows = []
    for side in (1, -1):
        tilt = -side * np.pi / 4
        cos, sin = np.cos(tilt), np.sin(tilt)
        rotation = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
        # the box's middle plane contains the edge, its lower face is the slanted surface
        center = [LENGTH / 2, side * _HALF_WIDTH, _HEIGHT]
        rows.append([*center, *half, *rotation.ravel(), _CONCRETE])
    return np.array(rows)


def _surroundings(
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return boxes, cylinders and spheres that stand before the portal at x = 0 and just behind it."""
    outer = _HALF_WIDTH + 1
    portal = [
        upright([0, outer - 0.1, -0.5], [2, 40, 11], _CONCRETE),
        upright([0, -40, -0.5], [2, 0.1 - outer, 11], _CONCRETE),
        upright([0, -outer, _HEIGHT + 0.9], [2, outer, 11], _CONCRETE),
    ]
    walls = [upright([-22, side * 8 - 0.3, -0.5], [0, side * 8 + 0.3, 3.5], 0.5) for side in (1, -1)]
    rows = 8
    along, aside, width, depth, height, reflectivity = draws(
        rng, rows, (-6.0, 6.0), (0.0, 6.0), (4.0, 8.0), (4.0, 7.0), (4.0, 14.0), (0.2, 0.7)
    )
    side = np.tile([1.0, -1.0], rows // 2)
    center = np.stack([-35 - 17.0 * np.repeat(np.arange(rows // 2), 2) + along, side * (18 + aside)], axis=1)
    half = np.stack([width, depth, height / 2], axis=1)
    houses = np.column_stack([center, height / 2, half, np.zeros(rows), reflectivity])
    niche = np.arange(8.0, FURNISHED, 13.0)[:, None] + rng.uniform(-2, 2, (4, 1))
    flank = np.resize([1.0, -1.0], (len(niche), 1)) * (_HALF_WIDTH - 0.15)
    cabinets = upright(
        np.hstack([niche - 0.5, flank - 0.2, 0 * niche + 0.3]),
        np.hstack([niche + 0.5, flank + 0.2, 0 * niche + 2.3]),
        0.6,
    )
    lamps = upright(
        np.hstack([niche + 4, 0 * niche - 0.2, 0 * niche + _HEIGHT - 0.3]),
        np.hstack([niche + 5.2, 0 * niche + 0.2, 0 * niche + _HEIGHT]),
        0.8,
    )
    spots = 10
    ahead, off, trunk, crown, shade = draws(
        rng, spots, (-75.0, -4.0), (7.0, 10.0), (0.12, 0.25), (1.2, 2.0), (0.2, 0.6)
    )
    place = np.stack([ahead, np.resize([1.0, -1.0], spots) * off], axis=1)
    place[ahead > -24, 1] += 3 * np.sign(place[ahead > -24, 1])
    trunks = np.column_stack([place, np.zeros(spots), trunk, np.full(spots, 3.5), shade])
    crowns = np.column_stack([place, np.full(spots, 3.5) + crown, crown, shade])
    return np.concatenate([*portal, *walls, houses, cabinets, lamps]), trunks, crowns
