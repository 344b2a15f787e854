"""Read inertial samples from a text table, one sample a line."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.cloud_stamps import times_to_ns
from lio_jax.data.sequence import ImuData
from lio_jax.data.text_table import read_text_table

_COLUMNS = "t, gyro_x, gyro_y, gyro_z, accel_x, accel_y, accel_z"
_PERIOD_NS = 5_000_000
_UNIT = re.compile(r"[\[(].*?[\])]")
_TIME = ("t", "time", "timestamp", "stamp")
_GYRO, _ACCEL = re.compile(r"w|gyr|ang|omega"), re.compile(r"a|acc|lin")


def read_imu_text(path: Path) -> tuple[ImuData, str]:
    """Return the samples of a table as they are written, and a note on the order of its columns.

    The table has commas or white space between its columns. A line of names before the samples states their
    order, for example that of EuRoC (``#timestamp [ns],w_RS_S_x [rad s^-1],...``). Without names there are
    seven columns: the time and two triples, of which the one as long as gravity is the specific force. Times
    are seconds, or whole numbers of ns, us or ms.

    Raises:
        LioJaxError: the table is empty, a line does not fit, or the order of the columns is not clear.
    """
    names, _, words, table = read_text_table(path, "samples", f"give a table with the columns {_COLUMNS}")
    width = table.shape[1]
    columns = None if names is None else _named(names)
    if columns is not None and max(columns) < width:
        note = "columns by their names"
    elif width == 7:
        columns, note = _by_gravity(path, table)
    else:
        raise LioJaxError(
            f"{path}: the order of its {width} columns is not known; name them in the first line: {_COLUMNS}."
        )
    try:
        stamps = times_to_ns([row[columns[0]] for row in words], _PERIOD_NS)
    except ValueError as error:
        raise LioJaxError(f"{path}: {error}; give times in seconds or whole ns.") from None
    gyro, accel = table[:, columns[1:4]], table[:, columns[4:7]]
    return ImuData(np.array(stamps, np.int64), gyro, accel), f"{path.name}: {note}"


def _named(names: Sequence[str]) -> list[int] | None:
    """Return the columns of time, rates and forces; None where the names do not state all of them."""
    # rostopic echo -p puts "field." before each name
    full = [_UNIT.sub("", name).strip().lower().removeprefix("field.") for name in names]
    time = [place for place, name in enumerate(full) if name.rpartition(".")[2] in _TIME]
    found = [time[0]] if time else []
    for kind, other in ((_GYRO, _ACCEL), (_ACCEL, _GYRO)):
        for axis in "xyz":
            places = [place for place, name in enumerate(full) if _is(name, axis, kind, other)]
            found += places if len(places) == 1 else []
    return found if len(found) == 7 and len(set(found)) == 7 else None


def _is(name: str, axis: str, kind: re.Pattern[str], other: re.Pattern[str]) -> bool:
    if not name.endswith(axis):
        return False
    first, second = kind.match(name), other.match(name)
    # "angular_velocity" begins like "acceleration" does
    return first is not None and (second is None or first.end() > second.end())


def _by_gravity(path: Path, table: NDArray[np.float64]) -> tuple[list[int], str]:
    with np.errstate(over="ignore", invalid="ignore"):
        first, second = (float(np.nanmedian(np.linalg.norm(table[:, at : at + 3], axis=1))) for at in (1, 4))
    for low, high in ((7.0, 13.0), (0.8, 1.25)):
        fits = [low <= strength <= high for strength in (first, second)]
        if fits == [False, True]:
            return [0, 1, 2, 3, 4, 5, 6], "columns t, rates, forces (the forces are as long as gravity)"
        if fits == [True, False]:
            return [0, 4, 5, 6, 1, 2, 3], "columns t, forces, rates (the forces are as long as gravity)"
    raise LioJaxError(
        f"{path}: neither triple of its columns is as long as gravity; name the columns in the first line: "
        f"{_COLUMNS}."
    )
