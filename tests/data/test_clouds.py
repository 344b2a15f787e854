"""Folders of clouds: every file format and every way to state stamps, against the sweep that was written."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data import open_sequence
from lio_jax.data.clouds import CloudFolder
from lio_jax.data.config import DataConfig
from lio_jax.data.trajectory import Trajectory, write_kitti_poses, write_tum
from tests.data import bags
from tests.data.bags import PERIOD_NS, START_NS
from tests.data.cloud_files import packed, pcd_bytes, ply_bytes

SEEN = bags.sweep()
POINTS = len(SEEN.points)
CLOUD = bags.fill(bags.VELODYNE, SEEN, SEEN.time)
BARE = bags.fill(np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]), SEEN)


def npy_bytes(array: np.ndarray) -> bytes:
    from io import BytesIO

    file = BytesIO()
    np.save(file, array)
    return file.getvalue()


FILES: dict[str, tuple[str, bytes]] = {
    "pcd ascii": (".pcd", pcd_bytes(CLOUD, "ascii")),
    "pcd binary": (".pcd", pcd_bytes(CLOUD)),
    "pcd compressed": (".pcd", pcd_bytes(CLOUD, "binary_compressed")),
    "ply ascii": (".ply", ply_bytes(CLOUD, "ascii")),
    "ply little endian": (".ply", ply_bytes(CLOUD)),
    "ply big endian": (".PLY", ply_bytes(CLOUD, "binary_big_endian")),
    "ply of CloudCompare": (".ply", ply_bytes(CLOUD, prefix="scalar_")),
    "npy with fields": (".npy", npy_bytes(packed(CLOUD))),
    "npy with rows": (".npy", npy_bytes(packed(CLOUD).reshape(bags.RINGS, -1))),
}


def folder(path: Path, names: list[str], content: bytes = pcd_bytes(CLOUD)) -> Path:
    path.mkdir(exist_ok=True)
    for name in names:
        (path / name).write_bytes(content)
    return path


def opened(path: Path, **config: object) -> CloudFolder:
    return CloudFolder(path, DataConfig(**config))  # type: ignore[arg-type]


def stamps(path: Path, **config: object) -> list[int]:
    return [scan.stamp_ns for scan in opened(path, **config).scans()]


@pytest.mark.parametrize("kind", FILES)
def test_every_format_gives_back_what_was_seen(tmp_path: Path, kind: str) -> None:
    suffix, content = FILES[kind]
    names = [f"{START_NS + number * PERIOD_NS}{suffix}" for number in range(3)]
    sequence = open_sequence(folder(tmp_path / "walk", names, content))
    assert (sequence.info.format, sequence.info.name, sequence.info.scan_count) == ("clouds", "walk", 3)
    stamped, timed = sequence.info.notes
    assert stamped == "stamps: ns in the names of the files"
    assert timed.startswith("per-point time: field 'time', float32 s relative, 0.0989 s a scan, ")
    scans = list(sequence.scans())
    assert [scan.stamp_ns for scan in scans] == [START_NS + number * PERIOD_NS for number in range(3)]
    for scan in scans:
        np.testing.assert_array_equal(scan.points, SEEN.points)
        np.testing.assert_array_equal(scan.ring, SEEN.ring)
        np.testing.assert_array_equal(scan.intensity, SEEN.intensity)
        np.testing.assert_allclose(scan.time, SEEN.time, atol=1e-8)
        assert scan.points.dtype == np.float32
        assert scan.points.flags.c_contiguous
    assert sequence.warnings_so_far == ()
    assert (sequence.imu(), sequence.gps(), sequence.truth()) == (None, None, None)


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        (".bin", np.column_stack([SEEN.points, SEEN.intensity]).astype("<f4").tobytes()),
        (".npy", npy_bytes(np.column_stack([SEEN.points, SEEN.intensity]))),
        (".npy", npy_bytes(SEEN.points.astype(np.float64))),
        (".pcd", pcd_bytes(BARE)),
    ],
)
def test_bare_points_get_times_and_rings(tmp_path: Path, suffix: str, content: bytes) -> None:
    sequence = opened(folder(tmp_path, [f"{number:06d}{suffix}" for number in range(3)], content))
    said = " ".join(sequence.info.notes)
    assert "scans are taken to be 0.1 s apart by the numbers in their names (config.data.scan_period)" in said
    assert "per-point time: not recorded, reconstructed from azimuth" in said
    assert "ring: not recorded, reconstructed from elevation as of 16 beams" in said
    scan = next(sequence.scans())
    np.testing.assert_array_equal(scan.points, SEEN.points)
    np.testing.assert_array_equal(scan.ring, SEEN.ring)
    np.testing.assert_allclose(scan.time, SEEN.time, atol=2e-3)
    scan = next(opened(tmp_path, compensated="yes").scans())
    assert scan.duration == 0.0


def test_rows_of_an_organised_cloud_are_rings(tmp_path: Path) -> None:
    sequence = opened(folder(tmp_path, ["1.pcd", "2.pcd"], pcd_bytes(BARE, rows=bags.RINGS)))
    np.testing.assert_array_equal(next(sequence.scans()).ring, SEEN.ring)


DRIVERS: dict[str, tuple[np.dtype, Callable[[int], np.ndarray], str]] = {
    "ouster": (bags.OUSTER, lambda start: np.round(SEEN.time * 1e9), "'t', uint32 ns relative"),
    "hesai": (bags.HESAI, lambda start: start * 1e-9 + SEEN.time, "'timestamp', float64 s absolute"),
    "livox": (bags.LIVOX_CLOUD, lambda start: start + SEEN.time * 1e9, "'timestamp', float64 ns absolute"),
}


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("driver", DRIVERS)
def test_fields_of_the_drivers_are_recognised(tmp_path: Path, driver: str, named: bool) -> None:
    layout, ticks, said = DRIVERS[driver]
    starts = [START_NS + number * PERIOD_NS for number in range(3)]
    for number, start in enumerate(starts):
        name = str(start) if named else f"cloud_{number}"
        (tmp_path / f"{name}.pcd").write_bytes(pcd_bytes(bags.fill(layout, SEEN, ticks(start))))
    sequence = opened(tmp_path)
    assert any(said in note for note in sequence.info.notes)
    scans = list(sequence.scans())
    for scan in scans:
        np.testing.assert_allclose(scan.time, SEEN.time, atol=1e-6)
        np.testing.assert_array_equal(scan.ring, SEEN.ring)
    # absolute times place scans whose names only count; relative times leave them counted
    expected = starts if named or "absolute" in said else [number * PERIOD_NS for number in range(3)]
    np.testing.assert_allclose([scan.stamp_ns for scan in scans], expected, atol=256)


EPOCH = 1_583_836_591_182_590_976
NAMES = {
    "ns": (lambda ns: f"{ns}", "ns in the names", 1),
    "us": (lambda ns: f"{ns // 1000}", "us in the names", 1000),
    "ms": (lambda ns: f"frame{ns // 1_000_000}", "ms in the names", 1_000_000),
    "seconds with fraction": (lambda ns: f"{ns // 10**9}.{ns % 10**9:09d}", "seconds in the names", 1),
    "float": (lambda ns: f"scan_{ns * 1e-9!r}", "seconds in the names", 1000),
    "seconds_nanoseconds": (lambda ns: f"cloud_{ns // 10**9}_{ns % 10**9}", "seconds in the names", 1),
    "seconds-nanoseconds": (lambda ns: f"{ns // 10**9}-{ns % 10**9:09d}", "seconds in the names", 1),
    "ns from the start": (lambda ns: f"{ns - EPOCH:012d}", "ns in the names", 1),
}


@pytest.mark.parametrize("kind", NAMES)
def test_stamps_come_from_the_names(tmp_path: Path, kind: str) -> None:
    name, said, resolution = NAMES[kind]
    # the second begins anew within these scans, so unpadded nanoseconds have fewer digits
    expected = [EPOCH + number * PERIOD_NS for number in range(12)]
    path = folder(tmp_path, [f"{name(stamp)}.pcd" for stamp in expected])
    if "from the start" in kind:
        expected = [stamp - EPOCH for stamp in expected]
    sequence = opened(path)
    assert said in sequence.info.notes[0]
    found = [scan.stamp_ns for scan in sequence.scans()]
    np.testing.assert_allclose(np.subtract(found, expected), 0, atol=resolution)


def test_counted_names_keep_their_gaps(tmp_path: Path) -> None:
    path = folder(tmp_path, ["9.pcd", "10.pcd", "8.pcd", "13.pcd"])
    assert stamps(path, scan_period=0.05) == [400_000_000, 450_000_000, 500_000_000, 650_000_000]


@pytest.mark.parametrize("names", [["c.pcd", "a.pcd", "b.pcd"], ["20100.pcd", "20000.pcd", "20200.pcd"]])
def test_other_names_are_counted_in_their_order(tmp_path: Path, names: list[str]) -> None:
    sequence = opened(folder(tmp_path, names))
    assert [scan.stamp_ns for scan in sequence.scans()] == [0, PERIOD_NS, 2 * PERIOD_NS]
    assert "not recorded, scans are taken to be 0.1 s apart in the order of" in sequence.info.notes[0]


@pytest.mark.parametrize("name", ["times.txt", "timestamps.txt"])
@pytest.mark.parametrize("lines", ["10.5\n10.6\n10.7\n", "# s\n10500000000\n10600000000\n\n10700000000"])
def test_a_file_of_times_has_precedence(tmp_path: Path, name: str, lines: str) -> None:
    path = folder(tmp_path, ["a10.pcd", "a9.pcd", "a11.pcd"])
    (path / name).write_text(lines)
    assert stamps(path) == [10_500_000_000, 10_600_000_000, 10_700_000_000]


def test_a_cut_out_takes_its_times_by_number(tmp_path: Path) -> None:
    path = folder(tmp_path, ["000001.pcd", "000002.pcd"])
    (path / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    assert stamps(path) == [100_000_000, 200_000_000]
    assert "it has 4 entries, a cut-out" in opened(path).info.notes[0]


@pytest.mark.parametrize("text", ["0.0\n0.1\n", "0.0\nnone\n0.2\n", "0.0 a\n0.1 b\n0.2 c\n", ""])
def test_times_that_do_not_fit_are_an_error(tmp_path: Path, text: str) -> None:
    path = folder(tmp_path, ["a.pcd", "b.pcd", "c.pcd"])
    (path / "times.txt").write_text(text)
    with pytest.raises(LioJaxError, match=r"times\.txt: .*give one time"):
        opened(path)


def test_an_empty_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LioJaxError, match=r"the folder is empty; give .*a folder of clouds"):
        open_sequence(tmp_path)
    with pytest.raises(LioJaxError, match=r"holds no clouds \(\.pcd, \.ply, \.npy, \.bin, \.las\)"):
        opened(tmp_path)


def test_mixed_types_are_an_error(tmp_path: Path) -> None:
    folder(tmp_path, ["1.pcd", "2.pcd", "map.ply"])
    with pytest.raises(LioJaxError, match=r"several kinds \(2 \.pcd, 1 \.ply\); leave one kind there"):
        open_sequence(tmp_path)


def test_a_name_without_number_among_numbers_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LioJaxError, match="the name 'map' holds no number, as other names do"):
        opened(folder(tmp_path, ["1.pcd", "2.pcd", "map.pcd"]))


def test_several_series_with_the_same_numbers_are_an_error(tmp_path: Path) -> None:
    path = folder(tmp_path, ["raw_0.pcd", "raw_1.pcd", "map_0.pcd", "map_1.pcd"])
    with pytest.raises(LioJaxError, match=r"several series with the same numbers \('map_', 'raw_'\)"):
        opened(path)


def test_one_stray_copy_is_a_duplicate(tmp_path: Path) -> None:
    sequence = opened(folder(tmp_path, ["raw_0.pcd", "raw_1.pcd", "raw_2.pcd", "old_1.pcd"]))
    assert len(list(sequence.scans())) == 3
    assert "has the same stamp as" in sequence.warnings_so_far[0]


def test_rows_of_another_size_are_an_error(tmp_path: Path) -> None:
    # x, y, z alone
    path = folder(tmp_path, ["0.bin", "1.bin", "2.bin"], bytes(12 * 1001))
    with pytest.raises(LioJaxError, match=r"3 of its 3 \.bin files hold no whole rows of x, y, z"):
        opened(path)


def test_equal_stamps_are_dropped_and_named(tmp_path: Path) -> None:
    sequence = opened(folder(tmp_path, ["a_12.5.pcd", "b_12.5.pcd", "c_12.6.pcd"]))
    assert len(list(sequence.scans())) == 2
    assert "b_12.5.pcd has the same stamp as" in sequence.warnings_so_far[0]


def test_points_without_a_return_are_dropped_and_counted(tmp_path: Path) -> None:
    cloud = CLOUD.copy()
    cloud["x"][3] = np.nan
    cloud["y"][7] = np.inf
    for axis in "xyz":
        cloud[axis][9] = 0.0
    for kind in ("ascii", "binary"):
        path = folder(tmp_path / kind, ["1.pcd", "2.pcd"], pcd_bytes(cloud, kind))
        scan = next(opened(path).scans())
        np.testing.assert_array_equal(scan.points, np.delete(SEEN.points, [3, 7, 9], axis=0))
        assert len(scan.time) == len(scan.ring) == POINTS - 3
        assert scan.dropped == 3


ROW = packed(CLOUD).itemsize


@pytest.mark.parametrize(
    ("kind", "cut", "left"),
    [
        ("pcd binary", 5 * ROW, POINTS - 5),
        ("pcd ascii", 0, 10),
        ("ply little endian", 5 * ROW + 3, POINTS - 6),
        ("ply ascii", 0, 9),
    ],
)
def test_a_truncated_file_gives_its_whole_points(tmp_path: Path, kind: str, cut: int, left: int) -> None:
    suffix, content = FILES[kind]
    path = folder(tmp_path, [f"{number}{suffix}" for number in range(3)], content)
    if cut:
        whole = content[:-cut]
    else:
        lines = content.split(b"\n")
        head = next(at for at, line in enumerate(lines) if line.startswith((b"DATA", b"end_header"))) + 1
        whole = b"\n".join(lines[: head + 10])
        whole = whole if left == 10 else whole[:-30]
    (path / f"1{suffix}").write_bytes(whole)
    sequence = opened(path)
    assert [len(scan.points) for scan in sequence.scans()] == [POINTS, left, POINTS]
    assert f"truncated ({left} of {POINTS} points)" in sequence.warnings_so_far[0]


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("length", [0, 20, 150, 300])
def test_a_file_without_its_header_or_its_points_is_skipped(tmp_path: Path, kind: str, length: int) -> None:
    suffix, content = FILES[kind]
    path = folder(tmp_path, [f"{number}{suffix}" for number in range(3)], content)
    (path / f"1{suffix}").write_bytes(content[:length])
    sequence = opened(path)
    assert [len(scan.points) for scan in sequence.scans() if len(scan.points)].count(POINTS) == 2
    assert f"1{suffix}: " in sequence.warnings_so_far[0]


def test_a_folder_without_a_readable_cloud_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LioJaxError, match=r"no cloud can be read; .*2\.pcd: cannot be read"):
        opened(folder(tmp_path, ["1.pcd", "2.pcd"], b"# .PCD v0.7\n"))


@pytest.mark.parametrize("array", [np.zeros((5, 7)), np.zeros(3), np.array([["a", "b", "c"]])])
def test_other_arrays_are_an_error(tmp_path: Path, array: np.ndarray) -> None:
    with pytest.raises(LioJaxError, match="has neither 3 columns"):
        opened(folder(tmp_path, ["1.npy"], npy_bytes(array)))


def test_las_without_its_library_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(LioJaxError, match=r"1\.las: .* install it with pip install 'lio-jax\[las\]'"):
        opened(folder(tmp_path, ["1.las", "2.las"], b"LASF"))


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    folder(tmp_path, ["1.npy"], npy_bytes(np.array([{"code": 1}], dtype=object)))
    with pytest.raises(LioJaxError, match="no cloud can be read"):
        opened(tmp_path)


def test_fields_that_are_missing_are_named(tmp_path: Path) -> None:
    path = folder(tmp_path, [f"{number}.pcd" for number in range(10)])
    with pytest.raises(LioJaxError, match=r"0\.pcd: config\.data\.time_field='t' is not a field"):
        opened(path, time_field="t")
    flat = np.zeros(3, [("x", "<f4"), ("y", "<f4")])
    (path / "9.pcd").write_bytes(pcd_bytes(flat))
    sequence = opened(path)
    assert len(list(sequence.scans())) == 9
    assert "9.pcd: the point cloud has no field 'z'" in sequence.warnings_so_far[0]
    (path / "0.pcd").write_bytes(pcd_bytes(flat))
    with pytest.raises(LioJaxError, match=r"0\.pcd: the point cloud has no field 'z'"):
        opened(path)


@pytest.mark.parametrize("unit", ["auto", "mm"])
def test_millimetres_are_converted(tmp_path: Path, unit: str) -> None:
    points = np.round(SEEN.points * 1000).astype(np.int32)
    sequence = opened(folder(tmp_path, ["1.npy", "2.npy"], npy_bytes(points)), length_unit=unit)
    np.testing.assert_allclose(next(sequence.scans()).points, SEEN.points, atol=6e-4)
    said = any("points in mm (median range 17" in note for note in sequence.info.notes)
    assert said == (unit == "auto")
    scan = next(opened(tmp_path, length_unit="m").scans())
    np.testing.assert_array_equal(scan.points, points.astype(np.float32))


def test_points_in_a_map_frame_are_noticed(tmp_path: Path) -> None:
    cloud = BARE.copy()
    cloud["y"] += 5_400_000.0
    sequence = opened(folder(tmp_path, ["1.pcd"], pcd_bytes(cloud)))
    assert "they must be in the frame of the lidar" in sequence.warnings_so_far[0]


IMU_STAMPS = START_NS + np.arange(20) * 5_000_000
RNG = np.random.default_rng(3)
GYRO = RNG.normal(0.0, 0.1, (20, 3)).round(6)
ACCEL = RNG.normal((0.0, 0.0, 9.81), 0.1, (20, 3)).round(6)
SECONDS = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in IMU_STAMPS.tolist()]
EUROC = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
ECHOED = ",".join(
    ["%time", "field.header.seq", "field.header.stamp", "field.orientation.x", "field.orientation.w"]
    + [f"field.angular_velocity.{axis}" for axis in "xyz"]
    + [f"field.linear_acceleration.{axis}" for axis in "xyz"]
)


def table(head: str, times: list[str], *columns: np.ndarray, comma: str = ",") -> str:
    rows = np.hstack(columns).tolist()
    lines = [comma.join([time, *map(repr, row)]) for time, row in zip(times, rows, strict=True)]
    return "\n".join([head, *lines] if head else lines) + "\n"


WHOLE = [str(stamp) for stamp in IMU_STAMPS.tolist()]
ZEROS = np.zeros((20, 1))
IMU_TABLES = {
    "EuRoC": table(EUROC, WHOLE, GYRO, ACCEL),
    "rostopic echo -p": table(
        ECHOED, WHOLE, ZEROS, IMU_STAMPS[:, None].astype(object), ZEROS, ZEROS, GYRO, ACCEL
    ),
    "forces first": table("t ax ay az gx gy gz".replace("g", "w"), SECONDS, ACCEL, GYRO, comma=" "),
    "names": table("time, acc_x, acc_y, acc_z, gyro_x, gyro_y, gyro_z", SECONDS, ACCEL, GYRO),
    "no names": table("", SECONDS, GYRO, ACCEL, comma=" "),
    "no names, forces first": table("", SECONDS, ACCEL, GYRO, comma=" "),
    "g": table("", SECONDS, GYRO, ACCEL / 9.80665),
}


@pytest.mark.parametrize("kind", IMU_TABLES)
def test_inertial_samples_come_from_a_table(tmp_path: Path, kind: str) -> None:
    name = "imu.csv" if "," in IMU_TABLES[kind] else "imu.txt"
    path = folder(tmp_path, [f"{START_NS}.pcd", f"{START_NS + PERIOD_NS}.pcd"])
    (path / name).write_text(IMU_TABLES[kind])
    sequence = opened(path)
    imu = sequence.imu()
    assert imu is not None
    np.testing.assert_array_equal(imu.stamp_ns, IMU_STAMPS)
    np.testing.assert_allclose(imu.gyro, GYRO, atol=1e-12)
    np.testing.assert_allclose(imu.accel, ACCEL, atol=1e-9)
    assert any(note.startswith(f"{name}: columns") for note in sequence.info.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no samples"),
        ("t,a,b\n", "holds no samples"),
        ("1.0 2.0 3.0\n", "the order of its 3 columns is not known"),
        ("1.0 0 0 0 0 0 9.8\n1.1 0 0 0 0\n", "line 2 does not hold 7 numbers"),
        ("1.0 0 0 0 0 0 3.0\n", "neither triple of its columns is as long as gravity"),
        ("nan 0 0 0 0 0 9.8\n", "give times in seconds"),
    ],
)
def test_a_table_that_is_not_clear_is_an_error(tmp_path: Path, text: str, message: str) -> None:
    path = folder(tmp_path, ["1.pcd"])
    (path / "imu.csv").write_text(text)
    with pytest.raises(LioJaxError, match=rf"imu\.csv: .*{message}"):
        opened(path).imu()


def test_truth_comes_from_a_tum_file_or_from_poses(tmp_path: Path) -> None:
    at = np.array([12_500_000_000, 12_600_000_000])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 2.0
    path = folder(tmp_path, ["12.5.pcd", "12.6.pcd"])
    write_kitti_poses(path / "poses.txt", poses)
    truth = opened(path).truth()
    assert truth is not None
    np.testing.assert_array_equal(truth.stamp_ns, at)
    np.testing.assert_allclose(truth.poses, poses)
    write_tum(path / "gt.tum", Trajectory(at + 1, poses))
    truth = opened(path).truth()
    assert truth is not None
    np.testing.assert_array_equal(truth.stamp_ns, at + 1)
    write_tum(path / "other.tum", Trajectory(at, poses))
    sequence = opened(path)
    assert sequence.truth() is None
    assert "several TUM files (gt.tum, other.tum)" in sequence.warnings_so_far[0]


def test_poses_for_other_clouds_are_an_error(tmp_path: Path) -> None:
    path = folder(tmp_path, ["12.5.pcd", "12.6.pcd"])
    write_kitti_poses(path / "poses.txt", np.eye(4)[None])
    with pytest.raises(LioJaxError, match="holds 1 poses for 2 clouds"):
        opened(path).truth()


def test_a_run_folder_is_no_folder_of_clouds(tmp_path: Path) -> None:
    folder(tmp_path, ["map.pcd"])
    (tmp_path / "trajectory.tum").write_text("0 0 0 0 0 0 0 1\n")
    (tmp_path / "config.yaml").write_text("recipe: default\n")
    with pytest.raises(LioJaxError, match="the layout is not known"):
        open_sequence(tmp_path)
