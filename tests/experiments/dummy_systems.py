"""Systems for the tests of the harness that runs systems in processes of their own."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np

from lio_jax.data.sequence import LidarScan


class Steady:
    """Return the scan's number, on request two scans late; may fail or die at a scan."""

    def __init__(self, late: bool, fails_at: int, dies_at: int) -> None:
        self._fails_at, self._dies_at = fails_at, dies_at
        self._stamps: list[int] = []
        if late:
            self.estimates: list[tuple[int, Any]] = []

    def warm_up(self, scans: list[LidarScan]) -> None:
        assert len(scans) == 3

    def prepare(self, scan: LidarScan) -> LidarScan:
        return scan

    def register(self, prepared: LidarScan) -> np.ndarray:
        number = len(self._stamps)
        self._stamps.append(prepared.stamp_ns)
        if number == self._fails_at:
            raise ValueError("too few points.")
        if number == self._dies_at:
            os.kill(os.getpid(), signal.SIGSEGV)
        pose = np.eye(4)
        pose[0, 3] = number
        if hasattr(self, "estimates") and number >= 2:
            self.estimates.append((self._stamps[number - 2], pose))
        return pose


def steady(late: bool, fails_at: int, dies_at: int, recording: Path) -> Steady:
    assert recording.is_dir()
    return Steady(late, fails_at, dies_at)
