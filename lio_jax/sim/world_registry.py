"""The worlds by name."""

from collections.abc import Callable

from lio_jax.core.errors import UsageError
from lio_jax.sim.city import city
from lio_jax.sim.office import office
from lio_jax.sim.open_worlds import field, room, street
from lio_jax.sim.stairs import stairs
from lio_jax.sim.tunnel import tunnel
from lio_jax.sim.worlds import Scene

WORLDS: dict[str, Callable[[int], Scene]] = {
    "city": city,
    "field": field,
    "office": office,
    "room": room,
    "stairs": stairs,
    "street": street,
    "tunnel": tunnel,
}
"""Builders by name: ``builder(seed) -> Scene``."""


def build(name: str, seed: int) -> Scene:
    """Return the world ``name`` (see WORLDS) for the seed ``seed``, with its route.

    Raises:
        UsageError: there is no such world.
    """
    if name not in WORLDS:
        raise UsageError(f"world '{name}' is unknown; choose one of: {', '.join(sorted(WORLDS))}.")
    return WORLDS[name](seed)
