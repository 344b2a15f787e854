"""Panes of glass: a ray is answered from behind the pane, from a mirror image, by the pane itself, or never.

A real pane splits each pulse, and the sensor reports the strongest return. Here each ray takes one of the
ways by chance, with the shares of light as probabilities. The share that is mirrored follows Schlick ("An
inexpensive BRDF model for physically-based rendering", 1994). Of several panes on a ray only the first one
acts, and a mirrored ray passes all panes. The body's way may pass through panes: they are not solids.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lio_jax.sim.primitives import Panes
from lio_jax.sim.raycast import Hit

_HEAD_ON = float(np.cos(np.deg2rad(2.0)))
"""Cosine of the incidence up to which the pane itself answers: its mirrored light meets the sensor."""
_BEHIND = 1e-6
"""Distance from the pane at which a mirrored ray starts, m."""


def seen_through(
    panes: Panes,
    cast: Callable[[Array, Array], Hit],
    origins: Float[Array, "n 3"],
    rays: Float[Array, "n 3"],
    direct: Hit,
    key: PRNGKeyArray,
) -> Hit:
    """Return what each ray reports where it may meet a pane.

    Args:
        panes: in the frame of the rays.
        cast: returns the first hits of rays, from origins (n, 3) m and unit directions (n, 3), without panes.
        origins: (n, 3) m.
        rays: (n, 3) unit directions.
        direct: first hits of these rays without the panes.
        key: draws which way a ray takes.

    Returns:
        Hits along ``rays``: a mirror image lies behind the pane, at the length of the whole way.
    """
    normals = jnp.cross(panes.along, panes.up)
    normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
    # a solid met before the pane hides it
    distance, which = _first_pane(panes, normals, origins, rays)
    met = distance < direct.distance
    way = jnp.where(met, distance, 0.0)[:, None]
    normal = normals[which]
    spot = origins + way * rays
    cosine = jnp.abs(jnp.sum(rays * normal, axis=1))
    share = panes.mirror[which]
    reflected = share + (1 - share) * (1 - cosine) ** 5
    by_mirror, by_loss = jax.random.uniform(key, (2, len(rays)), rays.dtype)

    away = _mirrored(rays, normal)
    image = cast(spot + _BEHIND * away, away)
    head_on = met & (cosine > _HEAD_ON)
    mirrored = met & ~head_on & (by_mirror < reflected)
    lost = met & ~head_on & ~mirrored & (by_loss < panes.missing[which])

    facing = -jnp.sign(jnp.sum(rays * normal, axis=1))[:, None] * normal
    cases = [head_on, mirrored, lost]
    endless = jnp.full_like(direct.distance, jnp.inf)
    lengths = [distance, distance + image.distance, endless]
    faces = [facing, _mirrored(image.normal, normal), jnp.zeros_like(facing)]
    shades = [jnp.ones_like(share), image.reflectivity, jnp.zeros_like(share)]
    return Hit(
        jnp.select(cases, lengths, direct.distance),
        jnp.select([case[:, None] for case in cases], faces, direct.normal),
        jnp.select(cases, shades, direct.reflectivity),
    )


def _first_pane(
    panes: Panes, normals: Float[Array, "p 3"], origins: Float[Array, "n 3"], rays: Float[Array, "n 3"]
) -> tuple[Float[Array, " n"], Array]:
    """Return the distance to the first pane on each ray, inf where there is none, and its row."""
    slope = rays @ normals.T
    height = jnp.sum(panes.center * normals, axis=1) - origins @ normals.T
    distance = height / jnp.where(slope == 0, 1.0, slope)
    offset = origins[:, None] + distance[..., None] * rays[:, None] - panes.center
    within = distance > _BEHIND
    for edge in (panes.along, panes.up):
        within &= jnp.abs(jnp.sum(offset * edge, axis=-1)) <= jnp.sum(edge * edge, axis=-1)
    distance = jnp.where(within & (slope != 0), distance, jnp.inf)
    return jnp.min(distance, axis=1), jnp.argmin(distance, axis=1)


def _mirrored(vectors: Float[Array, "n 3"], normals: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return vectors - 2 * jnp.sum(vectors * normals, axis=1, keepdims=True) * normals
