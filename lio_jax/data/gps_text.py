"""Read GPS fixes from a text table, one fix a line."""

import re
from pathlib import Path

import numpy as np

from lio_jax.core.errors import LioJaxError
from lio_jax.data.cloud_stamps import times_to_ns
from lio_jax.data.enu import geodetic_to_enu
from lio_jax.data.sequence import GpsData
from lio_jax.data.text_table import read_text_table

_COLUMNS = (
    "t, x, y, z (local, m) or t, latitude, longitude, altitude (deg, m), then sigma or three sigmas (m)"
)
_PERIOD_NS = 1_000_000_000
_LATITUDE = re.compile(r"lat")
_UNIT = re.compile(r"[\[(].*?[\])]")


def read_gps_text(path: Path) -> GpsData:
    """Return the fixes of a table in a local level frame, in which the first fix of degrees is the origin.

    The table has commas or white space between its columns: time, position, and for each fix one standard
    deviation or three (m). A line of names before the fixes may name the columns; with ``latitude`` and
    ``longitude`` among them the position is in degrees, else in metres. Fixes without a standard deviation
    have a covariance of NaN.

    Raises:
        LioJaxError: the table is empty, a line does not fit, a value is not finite or no latitude, or time
            does not ascend.
    """
    remedy = f"give a table with the columns {_COLUMNS}"
    names, lines, words, table = read_text_table(path, "fixes", remedy)
    width = table.shape[1]
    if width not in (4, 5, 7):
        raise LioJaxError(f"{path}: has {width} columns, not 4, 5 or 7; {remedy}.")
    if not (finite := np.isfinite(table).all(axis=1)).all():
        line = lines[int(np.argmin(finite))]
        raise LioJaxError(f"{path}: line {line} does not hold {width} finite numbers; fix or remove it.")
    try:
        stamps = np.array(times_to_ns([row[0] for row in words], _PERIOD_NS), np.int64)
    except ValueError as error:
        raise LioJaxError(f"{path}: {error}; give times in seconds or whole ns.") from None
    if (np.diff(stamps) <= 0).any():
        line = lines[int(np.argmax(np.diff(stamps) <= 0)) + 1]
        raise LioJaxError(
            f"{path}: time does not ascend at line {line}; sort the file and remove duplicates."
        )
    position, origin = table[:, 1:4], (np.nan,) * 3
    if names is not None and _LATITUDE.search(_UNIT.sub("", " ".join(names)).lower()):
        if (np.abs(position[:, 0]) > 90).any() or (np.abs(position[:, 1]) > 360).any():
            raise LioJaxError(f"{path}: a latitude above 90 or a longitude above 360 deg; give degrees.")
        first = position[0]
        origin = (float(first[0]), float(first[1]), float(first[2]))
        position = geodetic_to_enu(position, origin)
    sigma = np.full((len(table), 3), np.nan)
    if width > 4:
        sigma = np.broadcast_to(table[:, 4:], sigma.shape)
        if (sigma <= 0).any():
            line = lines[int(np.argmax((sigma <= 0).any(axis=1)))]
            raise LioJaxError(f"{path}: line {line} has a standard deviation that is not positive; fix it.")
    return GpsData(stamps, position, sigma[:, :, None] ** 2 * np.eye(3), origin)
