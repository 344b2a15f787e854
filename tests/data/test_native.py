import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.data.config import DataConfig
from lio_jax.data.native import NativeSequence
from lio_jax.data.native_writer import write_native
from lio_jax.data.sequence import GpsData, ImuData, LidarScan
from lio_jax.data.trajectory import Trajectory

EPOCH_NS = 1_700_000_000_123_456_789


def scan_number(number: int, points: int = 50) -> LidarScan:
    rng = np.random.default_rng(number)
    return LidarScan(
        stamp_ns=EPOCH_NS + number * 100_000_001,
        points=rng.normal(0.0, 10.0, (points, 3)).astype(np.float32),
        time=np.sort(rng.uniform(0.0, 0.1, points)).astype(np.float32),
        ring=rng.integers(0, 16, points).astype(np.int32),
        intensity=rng.uniform(0.0, 255.0, points).astype(np.float32),
        duration=0.1 + number * 1e-9,
    )


def scans(count: int) -> Iterator[LidarScan]:
    return (scan_number(number) for number in range(count))


def opened(path: Path, **config: object) -> NativeSequence:
    return NativeSequence(path, DataConfig(**config))  # type: ignore[arg-type]


def assert_same_scan(left: LidarScan, right: LidarScan) -> None:
    assert (left.stamp_ns, left.duration) == (right.stamp_ns, right.duration)
    for name in ("points", "time", "ring", "intensity"):
        a, b = getattr(left, name), getattr(right, name)
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes()


def test_everything_comes_back_bit_by_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    stamps = EPOCH_NS + np.arange(30, dtype=np.int64) * 5_000_001
    imu = ImuData(stamps, rng.normal(size=(30, 3)), rng.normal(size=(30, 3)), rng.normal(size=(30, 4)))
    gps = GpsData(stamps, rng.normal(size=(30, 3)), rng.normal(size=(30, 3, 3)), (49.1, 8.4, float("nan")))
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :3, :3] = Rotation.random(30, random_state=1).as_matrix()
    poses[:, :3, 3] = rng.normal(0.0, 50.0, (30, 3))
    extrinsic = np.eye(4)
    extrinsic[:3, 3] = rng.normal(size=3)
    written = write_native(
        tmp_path / "street",
        scans(4),
        name="a street",
        sensor="VLP-16",
        T_imu_lidar=extrinsic,
        imu=imu,
        gps=gps,
        truth=Trajectory(stamps, poses),
        truth_arrays={"gyro_noise": 1e-3, "biases": rng.normal(size=(5, 6))},
    )
    sequence = opened(tmp_path / "street")
    read = list(sequence.scans())
    assert written == len(read) == sequence.info.scan_count == 4
    for number, scan in enumerate(read):
        assert_same_scan(scan, scan_number(number))
    info = sequence.info
    assert (info.name, info.sensor, info.format) == ("a street", "VLP-16", "native")
    np.testing.assert_array_equal(info.T_imu_lidar, extrinsic)
    read_imu, read_gps, truth = sequence.imu(), sequence.gps(), sequence.truth()
    assert read_imu is not None
    assert read_gps is not None
    assert truth is not None
    for name in ("stamp_ns", "gyro", "accel", "orientation"):
        np.testing.assert_array_equal(getattr(read_imu, name), getattr(imu, name))
    for name in ("stamp_ns", "position", "covariance", "origin"):
        np.testing.assert_array_equal(getattr(read_gps, name), getattr(gps, name))
    np.testing.assert_array_equal(truth.stamp_ns, stamps)
    np.testing.assert_allclose(truth.poses, poses, atol=2e-8)  # the text holds nine decimals
    assert float(sequence.truth_arrays()["gyro_noise"]) == 1e-3
    assert sequence.warnings_so_far == ()


def test_scans_alone_suffice(tmp_path: Path) -> None:
    write_native(tmp_path / "bare", scans(2))
    sequence = opened(tmp_path / "bare")
    assert sequence.info.name == "bare"
    assert sequence.info.T_imu_lidar is None
    assert (sequence.imu(), sequence.gps(), sequence.truth()) == (None, None, None)
    assert sequence.truth_arrays() == {}


def test_start_and_count_choose_scans(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(6))
    chosen = list(opened(tmp_path / "s").scans(2, 3))
    assert [(scan.stamp_ns - EPOCH_NS) // 100_000_001 for scan in chosen] == [2, 3, 4]


def test_empty_scans_are_kept(tmp_path: Path) -> None:
    write_native(tmp_path / "s", iter([scan_number(0), scan_number(1, points=0), scan_number(2)]))
    assert [len(scan.points) for scan in opened(tmp_path / "s").scans()] == [50, 0, 50]


def test_an_existing_folder_is_refused_and_untouched(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(3))
    with pytest.raises(LioJaxError, match="exists already"):
        write_native(tmp_path / "s", scans(1))
    assert opened(tmp_path / "s").info.scan_count == 3


def test_overwriting_replaces_the_whole_folder(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(3), truth_arrays={"a": 1.0})
    write_native(tmp_path / "s", scans(1), overwrite=True)
    assert opened(tmp_path / "s").info.scan_count == 1
    assert opened(tmp_path / "s").truth_arrays() == {}
    assert [entry.name for entry in tmp_path.iterdir()] == ["s"]


def test_what_is_not_native_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "draft.txt").write_text("years of work")
    with pytest.raises(LioJaxError, match="not a native recording"):
        write_native(tmp_path / "thesis", scans(1), overwrite=True)
    assert (tmp_path / "thesis" / "draft.txt").read_text() == "years of work"


def test_a_failure_while_writing_leaves_nothing(tmp_path: Path) -> None:
    def failing() -> Iterator[LidarScan]:
        yield scan_number(0)
        assert not (tmp_path / "s").exists()
        raise RuntimeError("sensor fell off")

    with pytest.raises(RuntimeError, match="sensor fell off"):
        write_native(tmp_path / "s", failing())
    assert list(tmp_path.iterdir()) == []


WRITES_AND_IS_KILLED = """
import os, signal, sys
from pathlib import Path
from lio_jax.data.native_writer import write_native
from tests.data.test_native import scan_number

def scans():
    yield scan_number(0)
    os.kill(os.getpid(), signal.SIGKILL)

write_native(Path(sys.argv[1]), scans())
"""


def test_what_a_killed_writer_left_is_removed_by_the_next_one(tmp_path: Path) -> None:
    killed = subprocess.run([sys.executable, "-c", WRITES_AND_IS_KILLED, tmp_path / "s"], timeout=60)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".s.")
    write_native(tmp_path / "s", scans(1))
    assert [entry.name for entry in tmp_path.iterdir()] == ["s"]


def test_a_writer_that_lives_is_left_alone(tmp_path: Path) -> None:
    def interleaved() -> Iterator[LidarScan]:
        yield scan_number(0)
        write_native(tmp_path / "s", scans(2))
        yield scan_number(1)

    write_native(tmp_path / "s", interleaved(), overwrite=True)
    assert opened(tmp_path / "s").info.scan_count == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["s"]


def test_a_failure_while_overwriting_leaves_the_old_folder(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(3))
    with pytest.raises(LioJaxError, match="no scans to write"):
        write_native(tmp_path / "s", iter(()), overwrite=True)
    assert opened(tmp_path / "s").info.scan_count == 3
    assert [entry.name for entry in tmp_path.iterdir()] == ["s"]


def test_a_scan_without_duration_lasts_until_its_last_point(tmp_path: Path) -> None:
    """The format's contract names no duration; folders written by others may lack it."""
    write_native(tmp_path / "s", scans(1))
    path = tmp_path / "s" / "scans" / "000000.npz"
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files if key != "duration"}
    np.savez(path, **arrays)
    scan = next(opened(tmp_path / "s").scans())
    assert scan.duration == pytest.approx(scan_number(0).time.max())


def test_nan_and_zero_points_are_dropped_with_their_fields(tmp_path: Path) -> None:
    scan = scan_number(0)
    scan.points[3] = np.nan
    scan.points[4] = 0.0
    write_native(tmp_path / "s", iter([scan]))
    read = next(opened(tmp_path / "s").scans())
    for name in ("points", "time", "ring", "intensity"):
        np.testing.assert_array_equal(getattr(read, name), np.delete(getattr(scan, name), [3, 4], axis=0))


def test_config_can_say_that_points_are_compensated(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(1))
    scan = next(opened(tmp_path / "s", compensated="yes").scans())
    assert scan.duration == 0.0
    assert not scan.time.any()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"not a zip"])
def test_an_unreadable_scan_is_skipped_and_named(tmp_path: Path, content: bytes) -> None:
    write_native(tmp_path / "s", scans(3))
    (tmp_path / "s" / "scans" / "000001.npz").write_bytes(content)
    sequence = opened(tmp_path / "s")
    assert len(list(sequence.scans())) == 2
    assert "000001.npz: cannot be read" in sequence.warnings_so_far[0]


def test_a_truncated_scan_is_skipped_and_named(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(3))
    path = tmp_path / "s" / "scans" / "000001.npz"
    path.write_bytes(path.read_bytes()[:700])
    sequence = opened(tmp_path / "s")
    assert len(list(sequence.scans())) == 2
    assert "000001.npz: cannot be read" in sequence.warnings_so_far[0]


def test_fields_of_different_length_are_refused(tmp_path: Path) -> None:
    scan = scan_number(0)
    write_native(
        tmp_path / "s", iter([LidarScan(1, scan.points, scan.time[:-1], scan.ring, scan.intensity, 0.1)])
    )
    sequence = opened(tmp_path / "s")
    assert list(sequence.scans()) == []
    assert "differ in length" in sequence.warnings_so_far[0]


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(2))
    np.savez(tmp_path / "s" / "scans" / "000001.npz", points=np.array([{"code": 1}], dtype=object))
    sequence = opened(tmp_path / "s")
    assert len(list(sequence.scans())) == 1
    assert "000001.npz" in sequence.warnings_so_far[0]


def test_missing_scans_are_named(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(4))
    (tmp_path / "s" / "scans" / "000002.npz").unlink()
    sequence = opened(tmp_path / "s")
    assert len(list(sequence.scans())) == 3
    assert "000002 are missing" in sequence.warnings_so_far[0]


def test_duplicate_and_backward_scans_are_left_out(tmp_path: Path) -> None:
    write_native(tmp_path / "s", (scan_number(number) for number in (0, 2, 2, 1, 3)))
    sequence = opened(tmp_path / "s")
    assert len(list(sequence.scans())) == 3
    assert "000002.npz has the same stamp" in sequence.warnings_so_far[0]
    assert "out of order" in sequence.warnings_so_far[1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 2}, "format_version is 2"),
        ({"format_version": None}, "format_version is None"),
        ({"T_imu_lidar": [[1, 2], [3, 4]]}, "T_imu_lidar is not four rows"),
    ],
)
def test_broken_meta_is_an_error(tmp_path: Path, change: dict[str, object], message: str) -> None:
    write_native(tmp_path / "s", scans(1))
    path = tmp_path / "s" / "meta.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    with pytest.raises(LioJaxError, match=f"meta.yaml: {message}"):
        opened(tmp_path / "s")


@pytest.mark.parametrize("text", ["a: [1, 2", "!!python/object/apply:os.system ['true']", ""])
def test_meta_that_is_no_plain_yaml_is_an_error(tmp_path: Path, text: str) -> None:
    write_native(tmp_path / "s", scans(1))
    (tmp_path / "s" / "meta.yaml").write_text(text)
    with pytest.raises(LioJaxError, match=r"meta\.yaml"):
        opened(tmp_path / "s")


def test_broken_samples_are_an_error(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(1))
    np.savez(tmp_path / "s" / "imu.npz", stamp_ns=np.zeros(3))
    with pytest.raises(LioJaxError, match=r"imu\.npz: lacks gyro, accel"):
        opened(tmp_path / "s").imu()
    (tmp_path / "s" / "imu.npz").write_bytes(b"x")
    with pytest.raises(LioJaxError, match=r"imu\.npz: cannot be read"):
        opened(tmp_path / "s").imu()
