"""Messages of small recordings that the tests of the bag reader share."""

from pathlib import Path

import numpy as np
import pytest

from lio_jax.data.config import DataConfig
from lio_jax.data.sequence import LidarScan
from tests.data import bags

AUTO = DataConfig()
SEEN = bags.sweep()
FORMATS = ["a.bag", "a.db3", "a.mcap"]


def scan_starts(count: int) -> list[int]:
    """Return the header stamps of so many scans, 10 Hz, ns."""
    return [bags.START_NS + number * bags.PERIOD_NS for number in range(count)]


def received(start_ns: int) -> int:
    """Return when a recorder gets the scan that starts then: a little after its end."""
    return start_ns + bags.PERIOD_NS + 3_000_000


def cloud_messages(path: Path, clouds: list[np.ndarray], topic: str = "/points") -> list[bags.Message]:
    """Return one message a cloud, at 10 Hz."""
    stamps = scan_starts(len(clouds))
    return [
        (topic, received(stamp), bags.cloud_message(stamp, cloud, bags.is_ros2(path)))
        for stamp, cloud in zip(stamps, clouds, strict=True)
    ]


def imu_messages(count: int, ros2: bool, gravity: float = 9.8) -> list[bags.Message]:
    step = 10_000_000
    return [
        (
            "/imu",
            bags.START_NS + number * step,
            bags.imu_message(bags.START_NS + number * step, ros2, accel=(0.0, 0.0, gravity)),
        )
        for number in range(count)
    ]


def in_order(messages: list[bags.Message]) -> list[bags.Message]:
    """Sort messages by receipt."""
    return sorted(messages, key=lambda message: message[1])


def check_seen(scan: LidarScan, start_ns: int, tolerance_ns: int = 0) -> None:
    """Assert that a scan is the sweep ``SEEN`` from that time on."""
    assert abs(scan.stamp_ns - start_ns) <= tolerance_ns
    np.testing.assert_array_equal(scan.points, SEEN.points)
    np.testing.assert_allclose(scan.time, SEEN.time, atol=1e-6)
    np.testing.assert_array_equal(scan.ring, SEEN.ring)
    np.testing.assert_array_equal(scan.intensity, SEEN.intensity)
    assert scan.duration == pytest.approx(SEEN.time.max(), abs=1e-6)
    assert scan.points.dtype == scan.time.dtype == scan.intensity.dtype == np.float32
    assert scan.ring.dtype == np.int32


def storage_file(path: Path) -> Path:
    """Return the file that holds a bag's messages."""
    if path.is_file():
        return path
    return next(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))
