import numpy as np

from lio_jax.data.order import in_time_order
from lio_jax.data.sequence import LidarScan


def scan_at(stamp_ns: int) -> LidarScan:
    none = np.zeros(0, np.float32)
    return LidarScan(stamp_ns, np.zeros((0, 3), np.float32), none, np.zeros(0, np.int32), none, 0.1)


def kept(stamps: list[int]) -> tuple[list[int], list[str]]:
    warnings: list[str] = []
    return [s.stamp_ns for s in in_time_order(map(scan_at, stamps), warnings.append, first=10)], warnings


def test_ascending_scans_pass() -> None:
    assert kept([1, 2, 5]) == ([1, 2, 5], [])


def test_a_duplicate_is_dropped_and_named() -> None:
    stamps, warnings = kept([100, 200, 200, 300])
    assert stamps == [100, 200, 300]
    assert len(warnings) == 1
    assert "scan 12" in warnings[0]
    assert "duplicate" in warnings[0]


def test_a_step_back_is_skipped_and_measured() -> None:
    stamps, warnings = kept([0, 2_000_000_000, 500_000_000, 1_000_000_000, 3_000_000_000])
    assert stamps == [0, 2_000_000_000, 3_000_000_000]
    assert len(warnings) == 2
    assert "scan 12 (0.500000000 s) is 1.500 s older than scan 11" in warnings[0]
