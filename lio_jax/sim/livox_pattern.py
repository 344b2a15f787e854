"""The rosette of a Livox sensor: two prisms that turn against each other steer six lasers at once.

A thin prism deflects along its own direction, so the pair points at a (e^{i p1} + e^{i p2}) in the plane of
small angles (horizontal, vertical), with a half the field of view's radius: petals through the centre. As
the prisms' rates have no short common period, sweep after sweep fills in what the last one left out.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.sim.lidar import Lidar, column_times_ns, outer_sum

_MILLIHERTZ_NS = 1_000_000_000_000
"""ns in which a thousandth of a turn per second makes one turn."""


class RosetteLidar(Lidar):
    """A sensor that looks along +x through two prisms; its beams are lines, fanned out vertically."""

    prism_mhz: tuple[int, int] = eqx.field(static=True)
    """Turns of the prisms in 1000 s, counter-clockwise seen along +x."""
    radius: float = eqx.field(static=True)
    """Half the angle of the field of view, of one line, rad."""
    fan: tuple[float, ...] = eqx.field(static=True)
    """Upward tilt of each line, in firing order, rad."""

    def phase(self, start_ns: int) -> Float[Array, "2"]:
        """Return how far each prism has turned beyond whole turns, (2,) turns."""
        # the start in Python's unbounded integers: exact however long the recording
        turned = [start_ns * rate % _MILLIHERTZ_NS / _MILLIHERTZ_NS for rate in self.prism_mhz]
        return jnp.array(turned)

    def directions(self, phase: Float[Array, "2"]) -> Float[Array, "columns beams 3"]:
        """Return the unit directions: the angles measured from +x, towards +y and +z."""
        columns, delays = column_times_ns(self), np.array(self.delay_ns)
        first, second = (
            2 * jnp.pi * (phase[number] + outer_sum(_turns(columns, rate), _turns(delays, rate)))
            for number, rate in enumerate(self.prism_mhz)
        )
        across = 0.5 * self.radius * (jnp.cos(first) + jnp.cos(second))
        upwards = 0.5 * self.radius * (jnp.sin(first) + jnp.sin(second)) + jnp.asarray(self.fan)
        angle = jnp.hypot(across, upwards)
        sideways = jnp.sinc(angle / jnp.pi)
        return jnp.stack([jnp.cos(angle), across * sideways, upwards * sideways], axis=-1)


def _turns(times_ns: NDArray[np.int64], rate_mhz: int) -> NDArray[np.float64]:
    return times_ns * rate_mhz % _MILLIHERTZ_NS / _MILLIHERTZ_NS
