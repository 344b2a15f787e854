"""A staircase between four floors: two flights and a half-landing for each storey, a lobby on each floor."""

import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.assembly import assembled, upright
from lio_jax.sim.worlds import Route, Scene

_STOREYS = 3
_STOREY = 3.4
"""Height from floor to floor, m."""
_STEPS, _TREAD = 10, 0.3
"""Number of steps of a flight, and depth of each step, m."""
_RUN, _RISE = _STEPS * _TREAD, _STOREY / 2 / _STEPS
_FLIGHT, _SPINE = 1.5, 0.3
"""Width of a flight, and of the wall between the two flights, m."""
_LANDING = 1.8
"""Depth of the half-landing, m."""
_LOBBY = (6.0, 4.0)
"""Depth of a lobby, and half its width, m."""
_SLAB = 0.25
_LAP = 0.05
"""Overlap of neighbouring boxes, so that no ray passes between them, m."""
_HAND = 1.35
"""Height of the sensor above the tread, m."""
_SIDE, _LANE = _FLIGHT + _SPINE / 2, (_FLIGHT + _SPINE) / 2
"""Distance from the stairwell's middle to its wall, and to the middle of a flight, m."""
_TOP = _STOREYS * _STOREY + 2.9
_TURN = -1.2
"""Where the walk crosses from one flight to the next in front of the stairs, m along x."""
_PAINT, _STONE = 0.7, 0.4


def stairs(seed: int) -> Scene:
    """Return the staircase and a walk up to the highest lobby and down again; ``seed`` changes the furniture.

    The builder's frame: flights run along x from 0 to the half-landing. The first flight is at y < 0, the
    second, which leads back, at y > 0. The lobbies are at x < 0.
    """
    rng = np.random.default_rng(seed)
    route = _route()
    boxes = [_hull(), *(_flights(storey * _STOREY) for storey in range(_STOREYS))]
    boxes += [_furniture(floor * _STOREY, rng) for floor in range(_STOREYS + 1)]
    highest = _STOREYS * _STOREY
    pillars = [[-3.0, _LANE, 0, 0.25, highest, 0.6], [-3.0, -0.8, highest, 0.25, _TOP - highest, 0.6]]
    world = assembled(route[0], boxes=np.concatenate(boxes), cylinders=pillars)
    return Scene(world, Route(route - route[0], closed=True, radius=0.5, speed=0.9, dynamics="handheld"))


def _hull() -> NDArray[np.float64]:
    depth, half = _LOBBY
    end = _RUN + _LANDING
    floors = _STOREY * np.arange(1, _STOREYS + 1)[:, None] * np.array([0, 0, 1])
    return np.concatenate(
        [
            upright([-depth, -half, 0], [end, half, _TOP], _PAINT),
            upright([0, _SIDE, -1], [end + 1, half + 1, _TOP + 1], _PAINT),
            upright([0, -half - 1, -1], [end + 1, -_SIDE, _TOP + 1], _PAINT),
            upright([0, -_SPINE / 2, -1], [_RUN, _SPINE / 2, _TOP + 1], _PAINT),
            upright(
                floors + np.array([-depth - 1, -half - 1, -_SLAB]),
                floors + np.array([_LAP, half + 1, 0]),
                _STONE,
            ),
            # a parapet closes the floor where no further flight goes up
            upright([-0.1, -_SIDE, _STOREYS * _STOREY], [0, 0, _STOREYS * _STOREY + 1], _PAINT),
        ]
    )


def _flights(floor: float) -> NDArray[np.float64]:
    half = floor + _STOREY / 2
    step = np.arange(_STEPS)
    ones = np.ones(_STEPS)
    thickness = _RISE + 0.18
    up = floor + (step + 1) * _RISE
    first = upright(
        np.stack([step * _TREAD, -_SIDE * ones, up - thickness], axis=1),
        np.stack([(step + 1) * _TREAD + _LAP, 0 * ones, up], axis=1),
        _STONE,
    )
    up = half + (step + 1) * _RISE
    second = upright(
        np.stack([_RUN - (step + 1) * _TREAD - _LAP, 0 * ones, up - thickness], axis=1),
        np.stack([_RUN - step * _TREAD, _SIDE * ones, up], axis=1),
        _STONE,
    )
    landing = upright([_RUN - _LAP, -_SIDE - 1, half - _SLAB], [_RUN + _LANDING + 1, _SIDE + 1, half], _STONE)
    return np.concatenate([first, second, landing])


def _furniture(floor: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return cupboards along the lobby's walls; they differ from floor to floor."""
    depth, half = _LOBBY
    middle = -depth / 2 + rng.uniform(-1.5, 1.5, 3)
    length, height = rng.uniform(0.4, 1.2, 3), rng.uniform(0.5, 2.2, 3)
    low = np.array(
        [
            [middle[0] - length[0], half - 0.5, floor],
            [middle[1] - length[1], -half, floor],
            [-depth, middle[2] + depth / 2 - length[2], floor],
        ]
    )
    high = np.array(
        [
            [middle[0] + length[0], half, floor + height[0]],
            [middle[1] + length[1], -half + 0.5, floor + height[1]],
            [-depth + 0.4, middle[2] + depth / 2 + length[2], floor + height[2]],
        ]
    )
    return upright(low, high, rng.uniform(0.2, 0.6, 3))


def _route() -> NDArray[np.float64]:
    turn = _RUN + 1.0
    # the walk's slope joins the middles of the treads
    half_tread = _TREAD / 2
    climb: list[list[float]] = []
    for storey in range(_STOREYS):
        floor, half = storey * _STOREY, (storey + 0.5) * _STOREY
        climb += [[_TURN, -_LANE, floor], [-half_tread, -_LANE, floor], [_RUN - half_tread, -_LANE, half]]
        climb += [[turn, -_LANE, half], [turn, _LANE, half], [_RUN + half_tread, _LANE, half]]
        climb += [[half_tread, _LANE, floor + _STOREY], [_TURN, _LANE, floor + _STOREY]]
    # at its ends the walk enters and leaves the stairs without crossing to another flight
    climb, top = climb[1:-1], _STOREYS * _STOREY
    above = [[-4.5, _LANE, top], [-4.5, -2.5, top], [_TURN, -2.5, top], [_TURN, _LANE, top]]
    below = [[_TURN, -_LANE, 0], [_TURN, 2.5, 0], [-4.8, 2.5, 0], [-4.8, -_LANE, 0]]
    points = [[-3.0, -_LANE, 0], *climb, *above, *climb[::-1], *below]
    return np.array(points) + np.array([0, 0, _HAND])
