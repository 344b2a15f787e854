"""Check by rays that a body's path meets no surface, before anything is simulated."""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.sim.raycast import cast
from lio_jax.sim.worlds import Counts, World, counts_along, nearest_part

CLEARANCE = 0.2
"""Radius around the body's origin that has to stay free, m."""

STEP = 0.02
"""Time between the checked positions, s: at 20 m/s the body moves by twice CLEARANCE in it."""

TOGETHER = 10
"""Number of consecutive positions for which moving bodies are placed once: 0.2 s."""
_GROUPS = 64
"""Number of groups of positions that one call checks."""

_AROUND = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
_AROUND /= np.linalg.norm(_AROUND, axis=1, keepdims=True)


def check_clear(world: World, times: NDArray[np.float64], positions: NDArray[np.float64]) -> None:
    """Raise unless the straight path from position to position is free with ``CLEARANCE`` around it.

    26 rays are cast around each position, at most 45 degrees apart. A pole thinner than 0.15 m may therefore
    come closer than ``CLEARANCE`` undetected, but the path cannot pass through it.

    Args:
        world: the surfaces that must not be touched.
        times: times of the positions, (n,) s, ascending by ``STEP``.
        positions: positions of the body, (n, 3) m, world frame.

    Raises:
        UsageError: the body comes too close to a surface; the message names the first time and place.
    """
    if len(times) == 0:
        return
    ahead = np.diff(positions, axis=0, append=positions[-1:])
    reach = float(np.linalg.norm(ahead, axis=1).max())
    # a group's part is centred on its first position
    radius = (TOGETHER + 1) * reach + 2 * CLEARANCE
    with jax.enable_x64(True):
        counts = counts_along(world, jnp.asarray(positions[::TOGETHER]), radius)
    size = _GROUPS * TOGETHER
    for start in range(0, len(times), size):
        # the last call repeats the last position to fill its shape, so that every call has one shape
        rows = np.minimum(np.arange(start, start + size), len(times) - 1)
        with jax.enable_x64(True):
            instants, places, ways = (
                jnp.asarray(part[rows].reshape(_GROUPS, TOGETHER, -1)) for part in (times, positions, ahead)
            )
            touched = _touched(world, instants, places, ways, counts)
        found = np.flatnonzero(np.asarray(touched).ravel())
        if found.size:
            row = int(rows[found[0]])
            x, y, z = positions[row]
            raise UsageError(
                f"the motion runs into a surface {times[row]:.2f} s after its start, at ({x:.2f}, {y:.2f}, "
                f"{z:.2f}) m in the world; keep {CLEARANCE} m clear of everything, end before that time, or "
                "choose another world, seed or trajectory."
            )


@eqx.filter_jit
def _touched(
    world: World,
    times: Float[Array, "groups n 1"],
    positions: Float[Array, "groups n 3"],
    ahead: Float[Array, "groups n 3"],
    counts: Counts,
) -> Bool[Array, "groups n"]:
    def of_group(group: tuple[Array, Array, Array]) -> Array:
        return _group_touched(world, group[0], group[1], group[2], counts)

    return jax.lax.map(of_group, (times, positions, ahead))


def _group_touched(
    world: World,
    times: Float[Array, "n 1"],
    positions: Float[Array, "n 3"],
    ahead: Float[Array, "n 3"],
    counts: Counts,
) -> Bool[Array, " n"]:
    part, _ = nearest_part(world, positions[0], times[0, 0], counts)
    step = jnp.linalg.norm(ahead, axis=1, keepdims=True)
    # a body at rest has no direction of motion: its ray points along x and is as long as the clearance
    forward = jnp.where(step > 0, ahead / jnp.where(step > 0, step, 1), jnp.array([1.0, 0.0, 0.0]))
    around = jnp.broadcast_to(jnp.asarray(_AROUND), (len(times), *_AROUND.shape))
    rays = jnp.concatenate([forward[:, None], around], axis=1)
    limit = jnp.concatenate([step, jnp.full((len(times), len(_AROUND)), CLEARANCE)], axis=1)
    origins = jnp.broadcast_to((positions - positions[0])[:, None], rays.shape)
    sent = jnp.broadcast_to(times - times[0], limit.shape)
    hit = cast(part, origins.reshape(-1, 3), rays.reshape(-1, 3), sent.ravel())
    return jnp.any(hit.distance.reshape(limit.shape) < limit, axis=1)
