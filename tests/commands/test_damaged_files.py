"""Damaged files that a fuzz campaign found: each is refused in one sentence that names it, or read."""

import json
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from lio_jax.data import write_native
from lio_jax.data.sequence import GpsData, ImuData, LidarScan
from lio_jax.data.trajectory import Trajectory, write_kitti_poses, write_tum
from tests.data import bags
from tests.data.bag_recordings import imu_messages, in_order, storage_file

LATIN = "caf\xe9".encode("latin-1")
COUNT = 3


@pytest.fixture
def refused(cli):
    """Return a function that runs a command and gives back its refusal."""

    def refuse(*words: object) -> str:
        done = cli(*words)
        assert done.status in (1, 2), done.out
        *others, sentence = done.err.splitlines()
        assert all(line.startswith(("note: ", "warning: ")) for line in others), done.err
        assert sentence.startswith("lio-jax: ")
        assert "unexpected" not in sentence
        assert "Error" not in sentence
        return sentence

    return refuse


@pytest.fixture
def accepted(cli):
    """Return a function that runs a command that does its job, and gives back its warnings."""

    def accept(*words: object) -> list[str]:
        done = cli(*words)
        assert done.status == 0, done.err
        lines = done.err.splitlines()
        assert all(line.startswith(("note: ", "warning: ")) for line in lines), done.err
        return [line for line in lines if line.startswith("warning: ")]

    return accept


def poses(count: int = COUNT) -> np.ndarray:
    made = np.tile(np.eye(4), (count, 1, 1))
    made[:, 0, 3] = np.arange(count)
    return made


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Return a KITTI sequence of three scans with times, calibration and poses."""
    folder = tmp_path / "04"
    (folder / "velodyne").mkdir(parents=True)
    for number in range(COUNT):
        np.full((5, 4), 1.0 + number, np.float32).tofile(folder / "velodyne" / f"{number:06d}.bin")
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    write_kitti_poses(folder / "poses.txt", poses())
    return folder


@pytest.fixture
def native(tmp_path: Path) -> Path:
    """Return a native folder of three scans with inertial samples, fixes and truth."""
    stamps = np.arange(COUNT, dtype=np.int64) * 100_000_000
    ones = np.ones((5, 3), np.float32)
    spread = np.zeros(5, np.float32)
    scans = [
        LidarScan(int(stamp), ones, spread, np.zeros(5, np.int32), np.zeros(5, np.float32), 0.1)
        for stamp in stamps
    ]
    write_native(
        tmp_path / "drive",
        scans,
        T_imu_lidar=np.eye(4),
        imu=ImuData(stamps, np.zeros((COUNT, 3)), np.ones((COUNT, 3))),
        gps=GpsData(stamps, np.zeros((COUNT, 3)), np.tile(np.eye(3), (COUNT, 1, 1)), (48.0, 11.0, 500.0)),
        truth=Trajectory(stamps, poses()),
    )
    return tmp_path / "drive"


def changed(path: Path, **arrays: object) -> None:
    """Replace arrays of an .npz file."""
    with np.load(path) as file:
        held = {name: file[name] for name in file.files}
    np.savez(path, **(held | arrays))


def to_native(data: Path) -> tuple[object, ...]:
    return ("export", data, "--to", "native", "--out", data.parent / "out")


@pytest.mark.parametrize("name", ["times.txt", "calib.txt", "poses.txt"])
def test_text_of_kitti_that_is_not_utf8(refused, kitti, name):
    (kitti / name).write_bytes(LATIN + (kitti / name).read_bytes())
    assert f"{kitti / name}: is not a text file; give " in refused(*to_native(kitti))


def test_a_byte_order_mark_is_no_damage(accepted, kitti):
    for name in ("times.txt", "calib.txt", "poses.txt"):
        (kitti / name).write_bytes(b"\xef\xbb\xbf" + (kitti / name).read_bytes())
    assert accepted(*to_native(kitti)) == []
    assert len((kitti.parent / "out" / "truth.tum").read_text().splitlines()) == COUNT


@pytest.mark.parametrize("name", ["timestamps.txt", "../calib_imu_to_velo.txt"])
def test_text_of_kitti_raw_that_is_not_utf8(refused, tmp_path, name):
    drive = tmp_path / "drive"
    points = drive / "velodyne_points"
    (points / "data").mkdir(parents=True)
    np.ones((5, 4), np.float32).tofile(points / "data" / "0000000000.bin")
    (points / "timestamps.txt").write_text("2011-09-26 13:02:00.1\n")
    path = (points if name == "timestamps.txt" else drive) / name
    path.write_bytes(LATIN)
    sentence = refused(*to_native(drive))
    assert f"{path.resolve()}: is not a text file; copy it again from the drive." in sentence


@pytest.mark.parametrize("stamp", ["2011-09-26 13:02:00.1-1", "1600-01-01 00:00:00.0", "2011-09-26"])
def test_timestamps_that_are_read_otherwise_than_they_are_meant(refused, tmp_path, stamp):
    points = tmp_path / "drive" / "velodyne_points"
    (points / "data").mkdir(parents=True)
    np.ones((5, 4), np.float32).tofile(points / "data" / "0000000000.bin")
    (points / "timestamps.txt").write_text(f"{stamp}\n")
    assert f"timestamps.txt: line 1 ('{stamp}') is not 'YYYY-MM-DD" in refused(*to_native(tmp_path / "drive"))


NO_ROTATIONS = {
    "mirrored": np.diag([1.0, 1.0, -1.0, 1.0]),
    "zero": np.diag([0.0, 0.0, 0.0, 1.0]),
    "scaled": np.diag([2.0, 2.0, 2.0, 1.0]),
    "huge": np.diag([1e300, 1.0, 1.0, 1.0]),
}


@pytest.mark.parametrize("wrong", NO_ROTATIONS.values(), ids=NO_ROTATIONS)
def test_poses_of_kitti_that_are_no_rotations(refused, kitti, wrong):
    damaged = poses()
    damaged[1] = wrong
    write_kitti_poses(kitti / "poses.txt", damaged)
    expected = f"{kitti / 'poses.txt'}: pose 2 is no rotation with a translation"
    assert expected in refused(*to_native(kitti))
    (kitti.parent / "estimate").mkdir()
    write_kitti_poses(kitti.parent / "estimate" / "poses.txt", poses())
    assert expected in refused("eval", kitti.parent / "estimate" / "poses.txt", kitti / "poses.txt")


def test_a_rotation_with_few_decimals_is_compared_as_the_nearest_one(accepted, kitti):
    text = (kitti / "poses.txt").read_text().replace("1.000000000e+00 0.000000000e+00", "1 0.003", 1)
    (kitti / "poses.txt").write_text(text)
    assert accepted("eval", kitti / "poses.txt", kitti / "poses.txt") == []


@pytest.mark.parametrize("wrong", ["nan", "inf"])
def test_a_pose_of_kitti_that_is_not_finite_is_left_out(accepted, kitti, wrong):
    text = (kitti / "poses.txt").read_text()
    (kitti / "poses.txt").write_text(text.replace("1.000000000e+00", wrong, 1))
    assert accepted(*to_native(kitti)) == []
    assert len((kitti.parent / "out" / "truth.tum").read_text().splitlines()) == COUNT - 1


@pytest.mark.parametrize("numbers", ["0 0 0 0 0 0 0 0 0 0 0 0", "nan -1 0 0 0 0 -1 0 1 0 0 0"])
def test_a_calibration_of_kitti_that_is_no_rotation(refused, kitti, numbers):
    (kitti / "calib.txt").write_text(f"Tr: {numbers}\n")
    assert f"{kitti / 'calib.txt'}: 'Tr' is no rotation with a translation" in refused(*to_native(kitti))


@pytest.mark.parametrize("word", ["1e30", "nan", "inf", "1.²", "99999999999999999999999"])
def test_a_time_that_nanoseconds_cannot_hold(refused, kitti, word):
    (kitti / "times.txt").write_text(f"0.0\n{word}\n0.2\n", encoding="utf-8")
    assert f"{kitti / 'times.txt'}: entry 2 ('{word}') is not a time" in refused(*to_native(kitti))
    write_tum(kitti / "a.tum", Trajectory(np.arange(COUNT), poses()))
    (kitti / "a.tum").write_text(f"{word} 0 0 0 0 0 0 1\n", encoding="utf-8")
    assert "a.tum: line 1 is not 't x y z" in refused("eval", kitti / "a.tum", kitti / "a.tum")


@pytest.mark.parametrize("name", ["999999999999.bin", "²²²²²².bin"])
def test_a_file_name_far_from_the_others(accepted, kitti, name):
    (kitti / "velodyne" / "000002.bin").rename(kitti / "velodyne" / name)
    warnings = accepted(*to_native(kitti))
    assert len(list((kitti.parent / "out" / "scans").iterdir())) == 2
    assert any("000002-999999999998 are missing" in line for line in warnings) == name.startswith("9")


@pytest.mark.parametrize("length", ["1e300", "1e-320", "0"])
def test_a_quaternion_of_no_length(refused, tmp_path, length):
    (tmp_path / "a.tum").write_text(f"0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 {length}\n")
    assert "a.tum: line 2 is not 't x y z" in refused("eval", tmp_path / "a.tum", tmp_path / "a.tum")


@pytest.mark.parametrize("word", ["nan", "inf"])
def test_a_quaternion_that_is_not_finite_is_left_out(accepted, native, word):
    path = native / "truth.tum"
    path.write_text(f"0 0 0 0 0 0 0 1\n0.1 1 0 0 {word} 0 0 1\n0.2 2 0 0 0 0 0 1\n")
    warning = f"warning: {path}: 1 poses held NaN or infinity and were dropped."
    assert accepted(*to_native(native)) == [warning]
    assert len((native.parent / "out" / "truth.tum").read_text().splitlines()) == COUNT - 1
    assert accepted("eval", path, native) == []


WRONG_ARRAYS = {
    "stamps of text": ("imu.npz", {"stamp_ns": np.array(["a"] * COUNT)}),
    "fewer samples": ("imu.npz", {"gyro": np.zeros((1, 3))}),
    "a scalar": ("imu.npz", {"stamp_ns": np.int64(3)}),
    "complex numbers": ("imu.npz", {"accel": np.zeros((COUNT, 3), complex)}),
    "two axes": ("gps.npz", {"position": np.zeros((COUNT, 2))}),
    "origin of tuples": ("gps.npz", {"origin": np.zeros(3, [("x", float)])}),
}


@pytest.mark.parametrize(("name", "arrays"), WRONG_ARRAYS.values(), ids=WRONG_ARRAYS)
def test_arrays_of_another_form(refused, native, name, arrays):
    changed(native / name, **arrays)
    sentence = refused(*to_native(native))
    assert f"{native / name}: cannot be read ({next(iter(arrays))} is an array (" in sentence
    assert sentence.endswith("; write the folder again.")


@pytest.mark.parametrize(
    "arrays",
    [
        {"time": np.zeros(5, [("x", float)])},
        {"ring": np.full(5, np.nan)},
        {"duration": np.float64(np.nan)},
        {"time": np.full(5, np.inf, np.float32)},
        {"stamp_ns": np.float64(1e300)},
        {"points": np.full((5, 3), "a")},
    ],
    ids=lambda arrays: next(iter(arrays)),
)
def test_a_scan_of_another_form_is_left_out(accepted, native, arrays):
    path = native / "scans" / "000001.npz"
    changed(path, **arrays)
    (warning,) = accepted(*to_native(native))
    assert warning.startswith(f"warning: {path}: cannot be read (")
    assert len(list((native.parent / "out" / "scans").iterdir())) == 2


@pytest.mark.parametrize("wrong", [np.zeros((4, 4)), np.full((4, 4), np.nan)], ids=["zero", "nan"])
def test_an_extrinsic_that_is_no_rotation(refused, native, wrong):
    text = json.dumps({"format_version": 1, "T_imu_lidar": wrong.tolist()}).replace("NaN", ".nan")
    (native / "meta.yaml").write_text(text)
    assert "meta.yaml: T_imu_lidar is no rotation with a translation; fix it." in refused(*to_native(native))


def test_samples_at_rest_that_are_no_numbers(refused, tmp_path):
    path = tmp_path / "imu.npz"
    np.savez(path, stamp_ns=np.arange(3), gyro=np.full((3, 3), "a"), accel=np.zeros((3, 3)))
    assert "imu.npz: gyro holds <U1, no numbers" in refused(
        "calibrate-imu", path, "--out", tmp_path / "a.yaml"
    )


STRANGE_YAML = {
    "nested deeply": "[" * 3000,
    "within itself": "&a {b: *a}",
    "a bomb": "a: &a [1,1,1,1,1,1,1,1,1,1]\n"
    + "".join(
        f"{new}: &{new} [{','.join([f'*{old}'] * 10)}]\n"
        for old, new in zip("abcdefg", "bcdefgh", strict=True)
    ),
    "a tag without a value": "recipe: !!timestamp 9",
    "no text": "recipe: caf\xe9",
}


@pytest.mark.parametrize("text", STRANGE_YAML.values(), ids=STRANGE_YAML)
def test_yaml_that_is_read_in_strange_ways(refused, tmp_path, text):
    path = tmp_path / "my.yaml"
    path.write_bytes(text.encode("latin-1"))
    commands = (
        ("run", tmp_path, "--recipe", path, "--out", tmp_path / "out"),
        ("run", tmp_path, "--params-from", path, "--out", tmp_path / "out"),
        ("ablate", path, "--out", tmp_path / "out"),
    )
    for words in commands:
        sentence = refused(*words)
        assert f"{path}: not valid YAML (" in sentence or f"{path}: is not a text file" in sentence
        assert len(sentence) < 600


def test_an_unknown_recipe_in_a_file(refused, tmp_path):
    (tmp_path / "my.yaml").write_text("recipe: '%'")
    sentence = refused("run", tmp_path, "--recipe", tmp_path / "my.yaml", "--out", tmp_path / "out")
    assert f"{tmp_path / 'my.yaml'}: recipe '%' is not known" in sentence
    (tmp_path / "my.yaml").write_text(
        "recipe: '%'\nsequences: [{sim: street}]\ngrid: {params.map.voxel_size: [1]}"
    )
    sentence = refused("ablate", tmp_path / "my.yaml", "--out", tmp_path / "out")
    assert f"{tmp_path / 'my.yaml'}: recipe '%' is not known" in sentence


def test_a_value_of_thousands_of_letters_is_cut(refused, tmp_path):
    (tmp_path / "my.yaml").write_text(f"config: {'a' * 5000}")
    sentence = refused("run", tmp_path, "--recipe", tmp_path / "my.yaml", "--out", tmp_path / "out")
    assert "my.yaml: config = 'aaaaaaaa" in sentence
    assert len(sentence) < 400


def test_a_metric_that_is_a_list(refused, tmp_path):
    (tmp_path / "spec.yaml").write_text(
        "sequences: [{sim: street}]\ngrid: {params.map.voxel_size: [1.0]}\nmetrics: [[ate.rmse]]"
    )
    sentence = refused("ablate", tmp_path / "spec.yaml", "--out", tmp_path / "out")
    assert "spec.yaml: metrics: unknown metric '['ate.rmse']'" in sentence


def test_a_rotation_of_another_system_whose_squares_overflow(refused, tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text("lio_sam: {sensor: velodyne, extrinsicRot: [1.0e+200, 0, 0, 0, 1, 0, 0, 0, 1]}")
    sentence = refused("run", tmp_path, "--params-from", path, "--out", tmp_path / "out")
    assert "extrinsicRot is not a rotation: it holds 1e+200" in sentence


def test_weights_of_a_graph_that_are_too_far_apart(refused, accepted, tmp_path):
    source, out = tmp_path / "in.g2o", tmp_path / "out.g2o"
    lines = [f"VERTEX_SE2 {i} {i} 0 0.3" for i in range(4)]
    for i, j, weight in ((0, 1, "1e30"), (1, 2, "1"), (2, 3, "1"), (0, 3, "1")):
        lines.append(f"EDGE_SE2 {i} {j} {j - i} 0 0 1 0 0 {weight} 0 1")
    source.write_text("\n".join([*lines, "FIX 0"]) + "\n")
    # the edges determine no first guess; the solve then begins at the vertices' own poses
    (warning,) = accepted("optimize-graph", source, out)
    assert "in.g2o: not converged" in warning
    assert "nan" not in out.read_text()
    sentence = refused("optimize-graph", source, out, "--robust")
    assert "in.g2o: its equations have no solution; some weight is far too large or too small." in sentence


def test_a_vertex_so_far_away_that_its_cost_is_not_finite(cli, tmp_path):
    lines = ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1e200 0 0", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"]
    (tmp_path / "in.g2o").write_text("\n".join(lines) + "\n")
    done = cli("optimize-graph", tmp_path / "in.g2o", tmp_path / "out.g2o", "--json")
    assert done.status == 0, done.err
    assert json.loads(done.out)["initial_cost"] is None
    done = cli("optimize-graph", tmp_path / "in.g2o", tmp_path / "out.g2o")
    assert "cost        not finite -> " in done.out


@pytest.mark.parametrize("word", ["9" * 5000, "9" * 30])
def test_a_fixed_vertex_of_many_digits(refused, tmp_path, word):
    (tmp_path / "in.g2o").write_text(f"EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nFIX {word}\n")
    sentence = refused("optimize-graph", tmp_path / "in.g2o", tmp_path / "out.g2o")
    assert "in.g2o: line 2: '999999" in sentence
    assert sentence.endswith("is not a vertex's number.")


def test_a_length_in_an_mcap_that_asks_for_all_memory(refused, tmp_path):
    path = storage_file(bags.write_bag(tmp_path / "a.mcap", bags.velodyne_messages(2)))
    data = bytearray(path.read_bytes())
    # the first record behind the magic bytes is the header
    data[9:17] = struct.pack("<Q", 1 << 60)
    path.write_bytes(data)
    sentence = refused(*to_native(path))
    assert f"{path}: the bag was not closed properly or is truncated (" in sentence


def test_a_database_whose_table_of_topics_holds_no_text(refused, tmp_path):
    path = storage_file(bags.write_bag(tmp_path / "a.db3", bags.velodyne_messages(2)))
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("PRAGMA ignore_check_constraints = ON")
        database.execute("UPDATE topics SET name = x'00ff'")
    sentence = refused(*to_native(path))
    assert (
        f"{path}: the bag was not closed properly or is truncated (its list of topics is damaged)" in sentence
    )


def test_a_covariance_of_a_fix_that_is_impossibly_large(accepted, tmp_path):
    fixes = [
        (
            "/gps",
            bags.START_NS + number,
            bags.fix_message(bags.START_NS + number, 48.0, 11.0, variance=variance),
        )
        for number, variance in enumerate((4.0, 1e300, 4.0))
    ]
    path = bags.write_bag(tmp_path / "a.mcap", in_order(bags.velodyne_messages(2) + fixes))
    assert accepted(*to_native(path)) == []
    with np.load(tmp_path / "out" / "gps.npz") as file:
        np.testing.assert_array_equal(file["covariance"][:, 0, 0], [4.0, 25.0, 4.0])


def test_a_strength_of_an_accelerometer_beyond_all_squares(accepted, tmp_path):
    messages = imu_messages(30, ros2=True)
    messages[3][2].linear_acceleration.x = 1e300
    path = bags.write_bag(tmp_path / "a.mcap", in_order(bags.velodyne_messages(2) + messages))
    assert accepted(*to_native(path)) == []


def test_a_name_of_a_topic_with_line_breaks(accepted, tmp_path):
    messages = imu_messages(30, ros2=True)
    cut = [("/imu\n\0 a", received, message) for _, received, message in messages]
    path = bags.write_bag(tmp_path / "a.mcap", in_order(bags.velodyne_messages(2) + cut + messages[:3]))
    accepted(*to_native(path))


def test_records_of_a_bag_that_contradict_each_other(accepted, tmp_path):
    messages = in_order(bags.velodyne_messages(3, ros2=False) + imu_messages(30, ros2=False))
    path = bags.write_bag(tmp_path / "a.bag", messages)
    data = bytearray(path.read_bytes())
    # the time of the last message, which then lies outside the index of its chunk
    at = data.rfind(b"op=\x02")
    data[at + 3] = 0x09
    path.write_bytes(data)
    warnings = accepted(*to_native(path))
    assert any("the bag is damaged" in line for line in warnings)


def test_inertial_samples_whose_squares_are_beyond_all_numbers(accepted, native):
    changed(native / "imu.npz", accel=np.full((COUNT, 3), 1e300))
    accepted("inspect", native, "--json")


def test_stamps_beyond_64_bits(refused, tmp_path):
    stamps = np.arange(COUNT) * 1e300
    np.savez(tmp_path / "imu.npz", stamp_ns=stamps, gyro=np.ones((COUNT, 3)), accel=np.ones((COUNT, 3)))
    sentence = refused("calibrate-imu", tmp_path / "imu.npz", "--out", tmp_path / "out.yaml")
    assert f"{tmp_path / 'imu.npz'}: stamp_ns holds times beyond 64 bits of ns" in sentence
