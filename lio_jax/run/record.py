"""A record in the journal of a run: numbers by name, and arrays.

It is a header (length and CRC-32 of what follows), the length of a JSON text, that text, and the bytes of the
arrays that it describes. The header tells a record that a killed run has cut short.
"""

import json
import os
import struct
import zlib
from typing import Any, BinaryIO, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

_HEADER = struct.Struct("<QI")
_TEXT = struct.Struct("<I")


class Record(NamedTuple):
    """Numbers by name, and arrays."""

    values: dict[str, Any]
    arrays: list[NDArray[Any]]

    def as_bytes(self) -> bytes:
        """Return the record as it stands in a file."""
        arrays = [np.asarray(array, order="C") for array in self.arrays]
        shapes = [[array.dtype.name, array.shape] for array in arrays]
        text = json.dumps({"values": self.values, "arrays": shapes}).encode()
        # flat views: the bytes are copied once
        flat = [array.reshape(-1).view(np.uint8).data for array in arrays]
        payload = b"".join([_TEXT.pack(len(text)), text, *flat])
        return _HEADER.pack(len(payload), zlib.crc32(payload)) + payload


def read_record(file: BinaryIO) -> Record:
    """Return the record at a file's position.

    Raises:
        ValueError: it is cut short or damaged.
    """
    header = file.read(_HEADER.size)
    if len(header) < _HEADER.size:
        raise ValueError("it ends within a record")
    length, checksum = _HEADER.unpack(header)
    rest = os.fstat(file.fileno()).st_size - file.tell()
    payload = file.read(min(length, rest))
    if len(payload) != length or zlib.crc32(payload) != checksum:
        raise ValueError("a record is damaged")
    (end,) = _TEXT.unpack_from(payload)
    described = json.loads(payload[_TEXT.size : _TEXT.size + end])
    arrays, at = [], _TEXT.size + end
    for name, shape in described["arrays"]:
        dtype, size = jnp.dtype(name), int(np.prod(shape, dtype=np.int64))
        arrays.append(np.frombuffer(payload, dtype, size, at).reshape(shape))
        at += size * dtype.itemsize
    return Record(described["values"], arrays)
