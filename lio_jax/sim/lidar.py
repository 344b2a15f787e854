"""A spinning multi-beam LiDAR: all beams of a column fire at once, the columns one after another."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lio_jax.sim.raycast import cast
from lio_jax.sim.worlds import World


class SpinningLidar(eqx.Module):
    """Geometry, range limits and noise of the sensor."""

    elevation: Float[Array, " beams"]
    """Of each beam above the sensor's xy plane, from beam 0 upwards, rad."""
    columns: int = eqx.field(static=True)
    """Firings per turn."""
    period: float = eqx.field(static=True)
    """Duration of a turn, s."""
    range_sigma: Float[Array, ""]
    """Standard deviation of a range, m."""
    min_range: Float[Array, ""]
    """m."""
    max_range: Float[Array, ""]
    """m."""

    @property
    def beams(self) -> int:
        """Number of beams."""
        return self.elevation.shape[0]


class Sweep(eqx.Module):
    """One turn, column by column in firing order, misses included."""

    points: Float[Array, "columns beams 3"]
    """Lidar frame at each column's own firing time, m."""
    intensity: Float[Array, "columns beams"]
    """Reflectivity times the cosine of incidence, 0 to 255."""
    mask: Bool[Array, "columns beams"]
    """True where something within the range limits was met."""


def spinning_lidar(
    beams: int = 32,
    columns: int = 1024,
    *,
    rate: float = 10.0,
    elevation_deg: tuple[float, float] = (-25.0, 15.0),
    range_sigma: float = 0.02,
    min_range: float = 0.5,
    max_range: float = 100.0,
) -> SpinningLidar:
    """Return a sensor with evenly spread beams; ranges in m, ``rate`` in turns per second."""
    elevation = jnp.linspace(
        jnp.deg2rad(elevation_deg[0]), jnp.deg2rad(elevation_deg[1]), beams, dtype=jnp.float32
    )
    limits = (jnp.float32(value) for value in (range_sigma, min_range, max_range))
    return SpinningLidar(elevation, columns, 1.0 / rate, *limits)


def column_times(lidar: SpinningLidar) -> Float[Array, " columns"]:
    """Return the firing time of each column from the start of the turn, s."""
    return jnp.arange(lidar.columns) * (lidar.period / lidar.columns)


def beam_directions(lidar: SpinningLidar) -> Float[Array, "columns beams 3"]:
    """Return the unit directions in the lidar frame: clockwise from straight behind, as a Velodyne turns."""
    azimuth = jnp.pi - 2 * jnp.pi * jnp.arange(lidar.columns, dtype=jnp.float32) / lidar.columns
    level = jnp.cos(lidar.elevation)
    x = jnp.cos(azimuth)[:, None] * level
    y = jnp.sin(azimuth)[:, None] * level
    z = jnp.broadcast_to(jnp.sin(lidar.elevation), x.shape)
    return jnp.stack([x, y, z], axis=-1)


def sweep(lidar: SpinningLidar, world: World, T_world_column: jaxlie.SE3, key: PRNGKeyArray) -> Sweep:
    """Return one noisy turn.

    Args:
        lidar: the sensor.
        world: what it sees, float32, near the origin.
        T_world_column: lidar pose at each column's firing time, batch (columns,), float32.
        key: of this turn's noise.

    Returns:
        The turn's points in the frame that the lidar had when each was measured.
    """
    directions = beam_directions(lidar)
    shape = directions.shape[:2]
    rotation = T_world_column.rotation().as_matrix()
    origins = jnp.broadcast_to(T_world_column.translation()[:, None, :], directions.shape)
    rays = jnp.einsum("cij,cbj->cbi", rotation, directions, precision=jax.lax.Precision.HIGHEST)
    hit = cast(world, origins.reshape(-1, 3), rays.reshape(-1, 3))
    mask = (hit.distance >= lidar.min_range) & (hit.distance <= lidar.max_range)
    incidence = -jnp.sum(hit.normal * rays.reshape(-1, 3), axis=1)
    noise = lidar.range_sigma * jax.random.normal(key, mask.shape, jnp.float32)
    measured = jnp.where(mask, hit.distance + noise, 0)
    intensity = jnp.where(mask, 255 * hit.reflectivity * incidence, 0)
    return Sweep(measured.reshape(*shape, 1) * directions, intensity.reshape(shape), mask.reshape(shape))
