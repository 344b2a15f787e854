"""One sweep of a LiDAR: every ray is cast from the pose that the sensor has at the ray's own firing time.

Directions, poses and ranges are float64 (call it in JAX's x64 mode, ``jax.enable_x64``). Where a ray only
grazes a surface, an error in the last digit of a float32 direction is an error of a millimetre in range.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from numpy.typing import NDArray

from lio_jax.sim.glass import seen_through
from lio_jax.sim.raycast import cast
from lio_jax.sim.worlds import Part

_LN2 = 0.6931472


class Ranging(eqx.Module):
    """How a sensor measures distance, independent of its scan pattern."""

    sigma: Float[Array, ""]
    """Standard deviation of a range, m."""
    minimum: Float[Array, ""]
    """Nearest range that is reported, m."""
    maximum: Float[Array, ""]
    """Farthest range that is reported, m."""
    half_range: Float[Array, ""]
    """Range at which a white surface, met head-on, answers every second ray, m; inf: no ray is missed.

    The chance of an answer is 1 - 2^-s with s = reflectivity * cos(incidence) * (half_range / range)^2, which
    is proportional to the light that comes back: dark, slanted and far surfaces answer less often.
    """


def ranging(
    sigma: float = 0.02, minimum: float = 0.5, maximum: float = 100.0, half_range: float = float("inf")
) -> Ranging:
    """Return the range model with all lengths in m."""
    return Ranging(*(jnp.float32(value) for value in (sigma, minimum, maximum, half_range)))


class Lidar(eqx.Module):
    """A sensor that fires column after column; the beams of a column fire shortly one after another."""

    ranging: Ranging
    columns: int = eqx.field(static=True)
    """Number of columns in a sweep: how often each beam fires."""
    period_ns: int = eqx.field(static=True)
    """Duration of a sweep, ns."""
    delay_ns: tuple[int, ...] = eqx.field(static=True)
    """Delay of each beam after its column's time, ns, in firing order; all end before the next column."""
    ring: tuple[int, ...] = eqx.field(static=True)
    """Number of each beam as the sensor's driver reports it, in firing order."""

    @property
    def beams(self) -> int:
        """Number of beams."""
        return len(self.ring)

    @property
    def period(self) -> float:
        """Duration of a sweep, s."""
        return self.period_ns * 1e-9

    @abstractmethod
    def phase(self, start_ns: int) -> Float[Array, "2"]:
        """Return the scan pattern's state at a sweep's start, as :meth:`directions` needs it, (2,) turns.

        Args:
            start_ns: start of the sweep since the sensor was switched on, ns.
        """

    @abstractmethod
    def directions(self, phase: Float[Array, "2"]) -> Float[Array, "columns beams 3"]:
        """Return the unit direction of every ray in the lidar frame."""


class SpinningLidar(Lidar):
    """A head that turns clockwise seen from above; each sweep is one turn that starts straight behind."""

    elevation: tuple[float, ...] = eqx.field(static=True)
    """Elevation of each beam above the sensor's xy plane, in firing order, rad."""
    azimuth: tuple[float, ...] = eqx.field(static=True)
    """Azimuth of each beam relative to the head's direction, counter-clockwise, in firing order, rad."""

    def phase(self, start_ns: int) -> Float[Array, "2"]:
        """Return zeros: all turns have the same pattern."""
        return jnp.zeros(2)

    def directions(self, phase: Float[Array, "2"]) -> Float[Array, "columns beams 3"]:
        """Return the unit directions; the head also turns between the beams of a column."""
        head = np.pi - 2 * np.pi * column_times_ns(self) / self.period_ns
        beam = np.array(self.azimuth) - 2 * np.pi * np.array(self.delay_ns) / self.period_ns
        level, up = np.cos(self.elevation), np.sin(self.elevation)
        # by the angle sum, so that the compiled program's constants are columns and beams, not every ray
        cos, sin = (jnp.asarray(part)[:, None] for part in (np.cos(head), np.sin(head)))
        east, north = jnp.asarray(np.cos(beam) * level), jnp.asarray(np.sin(beam) * level)
        x, y = cos * east - sin * north, sin * east + cos * north
        return jnp.stack([x, y, jnp.broadcast_to(jnp.asarray(up), x.shape)], axis=-1)


class Sweep(eqx.Module):
    """One sweep, column by column in firing order, misses included."""

    points: Float[Array, "columns beams 3"]
    """Points in the lidar frame at each ray's own firing time, m."""
    intensity: Float[Array, "columns beams"]
    """Reflectivity times the cosine of incidence, 0 to 255 in whole steps."""
    mask: Bool[Array, "columns beams"]
    """True where the ray was answered within the range limits."""


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
    """Return an ideal sensor: beams evenly spread and fired at once, no missing answers.

    Args:
        beams: number of beams, counted from the lowest.
        columns: columns in a turn.
        rate: turns per second.
        elevation_deg: elevation of the lowest and of the highest beam, deg.
        range_sigma: standard deviation of a range, m.
        min_range: nearest range that is reported, m.
        max_range: farthest range that is reported, m.
    """
    elevation = np.deg2rad(np.linspace(elevation_deg[0], elevation_deg[1], beams))
    return SpinningLidar(
        ranging=ranging(range_sigma, min_range, max_range),
        columns=columns,
        period_ns=round(1e9 / rate),
        delay_ns=(0,) * beams,
        ring=tuple(range(beams)),
        elevation=tuple(elevation.tolist()),
        azimuth=(0.0,) * beams,
    )


def column_times_ns(lidar: Lidar) -> NDArray[np.int64]:
    """Return when each column starts to fire, (columns,) ns from the start of the sweep."""
    return np.arange(lidar.columns, dtype=np.int64) * lidar.period_ns // lidar.columns


def column_times(lidar: Lidar) -> NDArray[np.float64]:
    """Return when each column starts to fire, (columns,) s from the start of the sweep."""
    return np.asarray(column_times_ns(lidar) * 1e-9, np.float64)


def firing_times_ns(lidar: Lidar) -> NDArray[np.int64]:
    """Return when each ray is fired, (columns, beams) ns from the start of the sweep, ascending."""
    return column_times_ns(lidar)[:, None] + np.array(lidar.delay_ns, np.int64)


def outer_sum(of_column: NDArray[np.float64], of_beam: NDArray[np.float64]) -> Float[Array, "columns beams"]:
    """Return the sum of a quantity of each column and a quantity of each beam.

    Only the two summands become constants of a compiled program, not one number for each ray.
    """
    return jnp.asarray(of_column)[:, None] + jnp.asarray(of_beam)


def sweep(
    lidar: Lidar,
    part: Part,
    T_world_column: jaxlie.SE3,
    key: PRNGKeyArray,
    phase: Float[Array, "2"] | None = None,
) -> Sweep:
    """Return one noisy sweep.

    Args:
        lidar: the sensor.
        part: the part of a world around the lidar, placed at the sweep's start, near the origin.
        T_world_column: lidar pose at each column's time, batch (columns,).
        key: key of this sweep's noise.
        phase: result of ``lidar.phase``; None for a sensor whose sweeps all have the same pattern.

    Returns:
        The sweep's points in the lidar frame at each ray's firing time.
    """
    directions = lidar.directions(jnp.zeros(2) if phase is None else phase)
    shape = directions.shape[:2]
    origins, rays = _rays(lidar, T_world_column, directions)
    time = outer_sum(column_times(lidar), np.array(lidar.delay_ns) * 1e-9)
    hit = cast(part, origins, rays, time.ravel())
    if part.glass is not None:
        hit = seen_through(
            part.glass,
            lambda starts, ways: cast(part, starts, ways, time.ravel()),
            origins,
            rays,
            hit,
            jax.random.fold_in(key, 2),
        )
    model = lidar.ranging
    cosine = -jnp.sum(hit.normal * rays, axis=1)
    answer = hit.reflectivity * cosine
    # 1 - 2^-s, by comparing an exponential draw with s: this never divides by a zero range or cosine
    draw = jax.random.exponential(jax.random.fold_in(key, 1), answer.shape, jnp.float32) / _LN2
    answered = draw * (hit.distance / model.half_range) ** 2 <= answer
    mask = (hit.distance >= model.minimum) & (hit.distance <= model.maximum) & answered
    noise = model.sigma * jax.random.normal(key, mask.shape, jnp.float32)
    measured = jnp.where(mask, hit.distance + noise, 0)
    intensity = jnp.where(mask, jnp.round(255 * answer), 0)
    points, intensity = (
        values.astype(jnp.float32)
        for values in (measured.reshape(*shape, 1) * directions, intensity.reshape(shape))
    )
    return Sweep(points, intensity, mask.reshape(shape))


def _rays(
    lidar: Lidar, T_world_column: jaxlie.SE3, directions: Float[Array, "columns beams 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Return origins (m) and unit directions of the rays in the world.

    Within a column the pose moves linearly towards the next column's pose. Over h = 100 us the error is
    h^2/8 = 1.3e-9 s^2 times the acceleration, less than 1e-7 m.
    """
    rotation = T_world_column.rotation().as_matrix()
    position = T_world_column.translation()
    share = jnp.asarray(np.array(lidar.delay_ns) * lidar.columns / lidar.period_ns)
    origins = position[:, None] + share[:, None] * _step(position)[:, None]
    rays = _turned(rotation, directions) + share[:, None] * _turned(_step(rotation), directions)
    return origins.reshape(-1, 3), rays.reshape(-1, 3)


def _turned(
    rotation: Float[Array, "columns 3 3"], directions: Float[Array, "columns beams 3"]
) -> Float[Array, "columns beams 3"]:
    return jnp.einsum("cij,cbj->cbi", rotation, directions, precision=jax.lax.Precision.HIGHEST)


def _step(values: Float[Array, "columns ..."]) -> Float[Array, "columns ..."]:
    # the last column has no next one: its step is that of the column before
    steps = jnp.diff(values, axis=0)
    return jnp.concatenate([steps, steps[-1:]])
