"""Recordings: one protocol, one function that opens any of them."""

from lio_jax.data.inspect import Inspection, inspect_sequence
from lio_jax.data.inspect_table import format_inspection
from lio_jax.data.native_writer import write_native
from lio_jax.data.open import open_sequence
from lio_jax.data.prefetch import prefetched
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Sequence, SequenceInfo
from lio_jax.data.trajectory import Trajectory

__all__ = [
    "GpsData",
    "ImuData",
    "Inspection",
    "LidarScan",
    "Sequence",
    "SequenceInfo",
    "Trajectory",
    "format_inspection",
    "inspect_sequence",
    "open_sequence",
    "prefetched",
    "write_native",
]
