"""Sequences of evalio, a harness of LiDAR-inertial systems: its loader, calibration and truth."""

from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lio_jax.core.errors import LioJaxError
from lio_jax.data.config import DataConfig
from lio_jax.data.evalio_points import scan_of
from lio_jax.data.sequence import ImuData, LidarScan, Reader, SequenceBase, SequenceInfo, scans_from
from lio_jax.data.trajectory import Trajectory

_PREFIX = "evalio:"


class EvalioSequence(SequenceBase):
    """A sequence that evalio knows by a name such as ``newer_college_2020/short_experiment``.

    Evalio's loader has no fixes and reports no faults.
    """

    def __init__(self, path: Path, config: DataConfig) -> None:
        """Find the sequence; no scan is read yet.

        Args:
            path: ``evalio:DATASET/SEQUENCE``.
            config: not used, because evalio's loader knows each dataset.

        Raises:
            LioJaxError: evalio is not installed, does not know the sequence, or has no data of it.
        """
        super().__init__()
        name = str(path).removeprefix(_PREFIX)
        self._dataset = _dataset(name)
        lidar = self._dataset.lidar_params()
        self._rate = lidar.rate
        self.info = SequenceInfo(
            name=name.replace("/", "_"),
            format="evalio",
            path=str(path),
            scan_count=len(self._dataset),
            T_imu_lidar=np.array(self._dataset.imu_T_lidar().to_mat()),
            sensor=f"{lidar.brand} {lidar.model}",
            notes=("scans, calibration and truth are those of evalio's loader",),
        )

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans ``start`` to ``start + count``."""
        chosen = scans_from(start, count)
        for measurement in islice(self._dataset.data_iter().lidar_iter(), chosen.start, chosen.stop):
            yield scan_of(measurement, self._rate)

    def imu(self) -> ImuData | None:
        """Return all inertial samples."""
        return self._imu

    def truth(self) -> Trajectory | None:
        """Return the pose of the IMU in the truth's world, or None where evalio has no truth."""
        known = self._dataset.ground_truth()
        if known is None or not len(known):
            return None
        stamps = np.array([stamp.to_nsec() for stamp in known.stamps], np.int64)
        poses = np.stack([np.array(pose.to_mat()) for pose in known.poses])
        return Trajectory(stamps, poses)

    @cached_property
    def _imu(self) -> ImuData | None:
        samples = [(one.stamp.to_nsec(), one.gyro, one.accel) for one in self._dataset.data_iter().imu_iter()]
        if not samples:
            return None
        stamps, gyro, accel = zip(*samples, strict=True)
        return ImuData(np.array(stamps, np.int64), np.array(gyro, np.float64), np.array(accel, np.float64))


def _dataset(name: str) -> Any:
    try:
        from evalio import datasets
    except ImportError:
        raise LioJaxError(
            f"{_PREFIX}{name}: evalio is not installed; install it with pip install 'lio-jax[bench]'."
        ) from None
    found = datasets.get_sequence(name)
    if isinstance(found, datasets.SequenceNotFound):
        raise LioJaxError(
            f"{_PREFIX}{name}: evalio knows no such sequence; 'evalio ls datasets' lists them, the simulated "
            "worlds among them if EVALIO_CUSTOM=lio_jax.evalio is set."
        )
    if not found.is_downloaded():
        raise LioJaxError(
            f"{_PREFIX}{name}: evalio has no data of it in {found.folder}; get them with 'evalio dl {name}', "
            "or set EVALIO_DATA to the folder that holds them."
        )
    return found


READER = Reader(
    "evalio",
    "evalio:DATASET/SEQUENCE",
    lambda path: str(path).startswith(_PREFIX),
    EvalioSequence,
    reads=frozenset(),
    has_parts=False,
)
