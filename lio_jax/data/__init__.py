"""Recordings: one protocol for all formats, and one function that opens any of them."""

from lio_jax.data.detect import open_sequence
from lio_jax.data.native_writer import write_native
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Sequence, SequenceInfo, prefetched
from lio_jax.data.trajectory import Trajectory

__all__ = [
    "GpsData",
    "ImuData",
    "LidarScan",
    "Sequence",
    "SequenceInfo",
    "Trajectory",
    "open_sequence",
    "prefetched",
    "write_native",
]
