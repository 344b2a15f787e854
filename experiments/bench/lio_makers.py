"""Build the systems of the LiDAR-inertial comparison from a simulated recording, in any process."""

from pathlib import Path

import numpy as np
from inertial_peers import INERTIAL_PEERS, Rig
from isolated import Maker
from systems import PEERS, System

from lio_jax.data.config import DataConfig
from lio_jax.data.native import NativeSequence

_KISS = "kiss-icp"
PEER_NAMES = ("rko-lio", _KISS, "dlio", "lio-sam", "loam")
_NOISE = ("gyro_noise", "accel_noise", "gyro_bias_walk", "accel_bias_walk")


def peer_maker(name: str, threads: int) -> Maker:
    """Return the maker of a peer."""
    return Maker("lio_makers", "peer", (name, threads))


def our_name(recipe: str) -> str:
    """Return the name of one of our recipes in the tables: not that of a peer, whose poses are earlier."""
    return f"lio_jax-{recipe}" if recipe in PEER_NAMES else recipe


def our_maker(recipe: str, overrides: tuple[str, ...], threads: int) -> Maker:
    """Return the maker of one of our recipes."""
    return Maker("lio_makers", "ours", (recipe, overrides, threads))


def instant_of(name: str) -> tuple[float, str]:
    """Return the instant of a scan to which a system's poses refer (0 start, 1 end), and the reason."""
    if name not in PEER_NAMES:
        return 1.0, "states live at the scan's end"
    system = PEERS[name] if name in PEERS else INERTIAL_PEERS[name]
    return system.instant, system.instant_reason  # type: ignore[union-attr]


def peer(name: str, threads: int, recording: Path) -> System:
    """Return a new instance of a peer."""
    if name in PEERS:
        return PEERS[name](threads)
    system: System = INERTIAL_PEERS[name](threads, _rig(recording))
    return system


def ours(recipe: str, overrides: tuple[str, ...], threads: int, recording: Path) -> System:
    """Return a new instance of one of our recipes."""
    from lio_jax_system import LioJaxSystem, noise_for, sizes_for

    sequence = NativeSequence(recording, DataConfig())
    extrinsic = sequence.info.T_imu_lidar
    assert extrinsic is not None
    overrides = (*sizes_for(recipe, list(sequence.scans(0, 10))), *noise_for(recipe, sequence), *overrides)
    return LioJaxSystem(threads, np.asarray(extrinsic), overrides, sequence, recipe)


def _rig(recording: Path) -> Rig:
    sequence = NativeSequence(recording, DataConfig())
    imu = sequence.imu()
    assert imu is not None
    with np.load(recording / "truth.npz") as truth:
        return Rig(
            T_imu_lidar=truth["T_imu_lidar"],
            imu=imu,
            beams=int(truth["beams"]),
            columns=int(truth["columns"]),
            min_range=float(truth["min_range"]),
            max_range=float(truth["max_range"]),
            noise={name: float(truth[name]) for name in _NOISE},
            starts_at_rest=bool(truth["starts_at_rest"]),
        )
