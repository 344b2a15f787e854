"""Models of scanning LiDAR sensors: beams, timing and range limits."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.sim.lidar import (
    Lidar,
    Ranging,
    SpinningLidar,
    column_times_ns,
    outer_sum,
    ranging,
    spinning_lidar,
)

_MILLIHERTZ_NS = 1_000_000_000_000
"""Time that a rotation of 0.001 turns per second takes for one turn, ns."""


class RosetteLidar(Lidar):
    """A sensor that looks along +x through two rotating prisms; its beams are lines in a vertical fan."""

    prism_mhz: tuple[int, int] = eqx.field(static=True)
    """Turns of each prism in 1000 s, counter-clockwise seen along +x."""
    radius: float = eqx.field(static=True)
    """Half the angle of the field of view of one line, rad."""
    fan: tuple[float, ...] = eqx.field(static=True)
    """Upward tilt of each line, in firing order, rad."""

    def phase(self, start_ns: int) -> Float[Array, "2"]:
        """Return the fraction of a turn by which each prism has turned beyond whole turns, (2,) turns."""
        # Python's unbounded integers keep the start exact in recordings of any length
        turned = [start_ns * rate % _MILLIHERTZ_NS / _MILLIHERTZ_NS for rate in self.prism_mhz]
        return jnp.array(turned)

    def directions(self, phase: Float[Array, "2"]) -> Float[Array, "columns beams 3"]:
        """Return the unit directions; the angles are measured from +x, towards +y and +z."""
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


Layout = Literal["velodyne", "ouster", "livox"]
"""The make of LiDAR whose driver's message type a bag uses for the scans."""

_TURN_NS = 100_000_000
"""Duration of a sweep, ns: all sensors sweep at 10 Hz."""


@dataclass(frozen=True)
class Sensor:
    """A sensor that a user can choose by name."""

    build: Callable[[], Lidar]
    """Function that returns the sensor's model."""
    layout: Layout
    """The make of LiDAR whose driver's message type a bag uses for the scans."""
    description: str
    """What the list of sensors shows for it."""


def vlp16() -> SpinningLidar:
    """Return a VLP-16: beams 2 deg apart, fired every 2.304 us, interleaved, rings from the lowest."""
    upper, lower = np.arange(1.0, 16.0, 2.0), np.arange(-15.0, 0.0, 2.0)
    elevation = np.stack([lower, upper], axis=1).ravel()
    return _spinning(elevation, 1800, 2304 * np.arange(16), ranging(0.02, 0.5, 100.0, 250.0))


def hdl32() -> SpinningLidar:
    """Return an HDL-32E: beams 4/3 deg apart, fired every 1.152 us, interleaved, rings from the lowest."""
    ascending = (np.arange(32) * 4 - 92) / 3
    elevation = np.stack([ascending[:16], ascending[16:]], axis=1).ravel()
    return _spinning(elevation, 2170, 1152 * np.arange(32), ranging(0.02, 1.0, 100.0, 250.0))


def hdl64() -> SpinningLidar:
    """Return an HDL-64E: beams 1/3 deg apart in the upper block and 1/2 deg in the lower.

    One beam of each block fires at a time.

    Rings count from the highest beam, as in KITTI and A-LOAM.
    """
    upper, lower = 2.0 - np.arange(32) / 3, -8.83 - np.arange(32) / 2
    elevation = np.stack([upper, lower], axis=1).ravel()
    return _spinning(
        elevation, 2083, 1480 * (np.arange(64) // 2), ranging(0.02, 0.9, 120.0, 300.0), top_down=True
    )


def os1_64() -> SpinningLidar:
    """Return an OS1-64: 45 deg of view, beams staggered in azimuth and fired at once, rings from the top."""
    return _ouster(64)


def os1_128() -> SpinningLidar:
    """Return an OS1-128: an OS1-64 with twice the beams."""
    return _ouster(128)


def livox() -> RosetteLidar:
    """Return an Avia-like sensor: 70.4 x 77.2 deg, six lines, 240,000 rays a second, no repeated sweep.

    The prisms' rates are a choice of this package (no published ones were found): 100 s without repetition.
    """
    lines = 6
    fan = np.deg2rad(np.linspace(-3.4, 3.4, lines))
    return RosetteLidar(
        ranging=ranging(0.02, 1.0, 200.0, 600.0),
        columns=4000,
        period_ns=_TURN_NS,
        delay_ns=tuple(25_000 * line // lines for line in range(lines)),
        ring=tuple(range(lines)),
        prism_mhz=(121_570, -77_730),
        radius=math.radians(35.2),
        fan=tuple(fan.tolist()),
    )


SENSORS: dict[str, Sensor] = {
    "generic32": Sensor(spinning_lidar, "velodyne", "ideal, 32 beams x 1024 columns"),
    "vlp16": Sensor(vlp16, "velodyne", "Velodyne VLP-16"),
    "hdl32": Sensor(hdl32, "velodyne", "Velodyne HDL-32E"),
    "hdl64": Sensor(hdl64, "velodyne", "Velodyne HDL-64E"),
    "os1_64": Sensor(os1_64, "ouster", "Ouster OS1-64"),
    "os1_128": Sensor(os1_128, "ouster", "Ouster OS1-128"),
    "livox": Sensor(livox, "livox", "Livox Avia"),
}


def find_sensor(name: str) -> Sensor:
    """Return a sensor by its name.

    Raises:
        UsageError: there is none of that name.
    """
    if name not in SENSORS:
        raise UsageError(f"sensor '{name}' is unknown; choose one of: {', '.join(SENSORS)}.")
    return SENSORS[name]


def _ouster(beams: int) -> SpinningLidar:
    elevation = np.linspace(22.5, -22.5, beams)
    stagger = np.tile([3.16, 1.05, -1.05, -3.16], beams // 4)
    return _spinning(
        elevation,
        1024,
        np.zeros(beams, np.int64),
        ranging(0.015, 0.5, 120.0, 400.0),
        azimuth=stagger,
        top_down=True,
    )


def _spinning(
    elevation: NDArray[np.float64],
    columns: int,
    delay_ns: NDArray[np.int64],
    model: Ranging,
    azimuth: NDArray[np.float64] | None = None,
    top_down: bool = False,
) -> SpinningLidar:
    """Number the beams by elevation; angles in deg, in firing order."""
    ascending = np.argsort(np.argsort(elevation))
    ring = len(elevation) - 1 - ascending if top_down else ascending
    offset = np.zeros(len(elevation)) if azimuth is None else azimuth
    return SpinningLidar(
        ranging=model,
        columns=columns,
        period_ns=_TURN_NS,
        delay_ns=tuple(int(delay) for delay in delay_ns),
        ring=tuple(int(number) for number in ring),
        elevation=tuple(np.deg2rad(elevation).tolist()),
        azimuth=tuple(np.deg2rad(offset).tolist()),
    )
