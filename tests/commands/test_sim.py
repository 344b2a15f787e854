"""``lio-jax sim`` writes recordings that every reader opens, repeatably, whole or not at all."""

import shlex
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.commands import sim as command
from lio_jax.commands.sim_options import ErrorOptions, MotionOptions, SensorOptions
from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.native import NativeSequence
from lio_jax.data.trajectory import read_tum, write_kitti_poses
from tests.commands.conftest import PLAIN
from tests.full_disk import full_disk_after

WORDS = ("sim", "room", "--sensor", "vlp16", "--duration", 0.3, "--gps-rate", 20, "--seed", 4)
SCANS = 3
BAGS = {
    "a.bag": (),
    "a.db3": (),
    "a.mcap": (),
    "a": ("--format", "ros2-sqlite3"),
    "b": ("--format", "ros2-mcap"),
}


@pytest.fixture(scope="module")
def native(tmp_path_factory):
    """Return a native recording; not to be changed."""
    from lio_jax.cli import main

    path = tmp_path_factory.mktemp("sim") / "native"
    assert main([str(word) for word in (*WORDS, "--out", path)]) == 0
    return path


def _equal(recording, expected):
    scans, others = list(recording.scans()), list(expected.scans())
    assert len(scans) == len(others) == SCANS
    for one, other in zip(scans, others, strict=True):
        assert one.stamp_ns == other.stamp_ns
        for key in ("points", "time", "ring", "intensity"):
            np.testing.assert_array_equal(getattr(one, key), getattr(other, key))
    imu, expected_imu = recording.imu(), expected.imu()
    for key in ("stamp_ns", "gyro", "accel"):
        np.testing.assert_array_equal(getattr(imu, key), getattr(expected_imu, key))


def _bytes(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_native_folder(native):
    assert sorted(path.name for path in native.iterdir()) == [
        "gps.npz",
        "imu.npz",
        "meta.yaml",
        "scans",
        "truth.npz",
        "truth.tum",
    ]
    recording = NativeSequence(native, DataConfig())
    assert recording.info.name == "room_4"
    assert "VLP-16" in recording.info.sensor
    assert recording.info.T_imu_lidar is not None
    scans = list(recording.scans())
    assert len(scans) == SCANS
    assert all(len(scan.points) > 5000 for scan in scans)
    assert [later.stamp_ns - earlier.stamp_ns for earlier, later in pairwise(scans)] == [100_000_000] * 2
    imu, gps, truth = recording.imu(), recording.gps(), recording.truth()
    assert len(imu.stamp_ns) == 61
    assert len(gps.stamp_ns) == 7
    # all of it on one clock, and the truth covers every scan
    assert imu.stamp_ns[0] == gps.stamp_ns[0] == truth.stamp_ns[0] == scans[0].stamp_ns
    assert truth.stamp_ns[-1] == imu.stamp_ns[-1] == scans[-1].end_ns
    known = recording.truth_arrays()
    assert known["gyro_bias"].shape == known["accel_bias"].shape == (61, 3)
    assert known["gyro_noise"] == pytest.approx(0.003 / 200**0.5)
    np.testing.assert_allclose(known["T_imu_lidar"], recording.info.T_imu_lidar)


@pytest.mark.parametrize("name", BAGS)
def test_bags_hold_what_the_native_folder_holds(cli, tmp_path, native, name):
    done = cli(*WORDS, *BAGS[name], "--out", tmp_path / name)
    assert done.status == 0, done.err
    stem = name.split(".")[0]
    assert {path.name for path in tmp_path.iterdir()} == {name, f"{stem}.truth.tum", f"{stem}.truth.npz"}
    bag, expected = open_sequence(tmp_path / name), open_sequence(native)
    assert bag.info.format == "rosbag"
    _equal(bag, expected)
    assert len(bag.gps().stamp_ns) == 7
    assert (tmp_path / f"{stem}.truth.tum").read_bytes() == (native / "truth.tum").read_bytes()
    assert (tmp_path / f"{stem}.truth.npz").read_bytes() == (native / "truth.npz").read_bytes()
    assert "\r" not in done.out + done.err


def test_same_seed_same_bytes_and_another_seed_other_bytes(cli, tmp_path, native):
    assert cli(*WORDS, "--out", tmp_path / "again").status == 0
    assert _bytes(tmp_path / "again") == _bytes(native)
    for name, seed in (("one.bag", 4), ("two.bag", 4), ("other.bag", 5)):
        assert cli(*WORDS[:-1], seed, "--out", tmp_path / name).status == 0
    one, two, other = ((tmp_path / name).read_bytes() for name in ("one.bag", "two.bag", "other.bag"))
    assert one == two
    assert one != other


def test_the_printed_command_runs_the_bag(cli, tmp_path):
    """Moving from the start, so that a wrong extrinsic or time would show."""
    bag = tmp_path / "the room.bag"
    words = ("sim", "room", "--sensor", "vlp16", "--duration", 0.8, "--moving-start")
    done = cli(*words, "--out", bag)
    assert done.status == 0, done.err
    line = next(line for line in done.out.splitlines() if line.startswith("run it"))
    said = shlex.split(line.removeprefix("run it"))
    assert said[:2] == ["lio-jax", "run"]
    said[said.index("DIR")] = str(tmp_path / "out")
    ran = cli(*said[1:], *PLAIN)
    assert ran.status == 0, ran.err
    assert "8 of 8 poses compared" in ran.out
    evaluated = cli("eval", tmp_path / "out", tmp_path / "the room.truth.tum", "--json")
    assert evaluated.status == 0, evaluated.err


def test_overwriting_replaces_a_recording(cli, tmp_path):
    for name in ("a", "a.bag"):
        first = cli(*WORDS, "--out", tmp_path / name)
        again = cli(*WORDS, "--duration", 0.2, "--out", tmp_path / name, "--overwrite")
        assert first.status == again.status == 0, again.err
        assert open_sequence(tmp_path / name).info.scan_count == 2
    assert {path.name for path in tmp_path.iterdir()} == {"a", "a.bag", "a.truth.tum", "a.truth.npz"}
    assert len(read_tum(tmp_path / "a.truth.tum")) == 21


def test_poses_of_the_user(cli, tmp_path, native):
    done = cli("sim", "room", "--trajectory", native, "--imu-rate", 0, "--out", tmp_path / "a")
    assert done.status == 0, done.err
    recording = open_sequence(tmp_path / "a")
    assert recording.info.scan_count == SCANS
    assert recording.imu() is None
    assert recording.gps() is None
    given, moved = read_tum(native / "truth.tum"), recording.truth()
    np.testing.assert_allclose(moved.positions, given.positions, atol=1e-6)


# -- options reach the simulator


class Asked(Exception):
    """Carries the simulator's arguments out of the command."""


@pytest.fixture
def arguments(monkeypatch):
    """Return a function that gives the simulator's arguments for some options."""

    def stop(*words, **named):
        raise Asked(words, named)

    monkeypatch.setattr(command, "SimulatedSequence", stop)

    def ask(motion=None, sensors=None, errors=None, duration=5.0, sensor="vlp16"):
        with pytest.raises(Asked) as caught:
            command._sequence(
                "city",
                sensor,
                duration,
                7,
                motion or MotionOptions(),
                sensors or SensorOptions(),
                errors or ErrorOptions(),
            )
        words, named = caught.value.args
        return dict(zip(("world", "sensor", "duration_s", "seed"), words, strict=True)) | named

    return ask


def test_defaults(arguments):
    asked = arguments(duration=None)
    assert (asked["world"], asked["sensor"], asked["seed"]) == ("city", "vlp16", 7)
    assert asked["duration_s"] == 60.0
    assert asked["imu"].rate == 200.0
    assert asked["gps"] is None
    assert asked["T_imu_lidar"] is None
    assert asked["standstill_s"] is None
    assert not asked["moving_start"]


def test_motion_options(arguments, native):
    asked = arguments(motion=MotionOptions(standstill=3.0, moving_start=True, swing_rate=4.0))
    assert asked["standstill_s"] == 3.0
    assert asked["swing_rate"] == 4.0
    assert asked["moving_start"] is True
    asked = arguments(motion=MotionOptions(trajectory=native / "truth.tum"), duration=None)
    assert asked["duration_s"] is None
    assert len(asked["trajectory"]) == 31


def test_sensor_options(arguments):
    turned = Rotation.from_euler("xyz", [0.1, 0.2, 0.3])
    asked = arguments(
        sensors=SensorOptions(
            imu_rate=400.0,
            gps_rate=2.0,
            lidar_translation=(1.0, 2.0, 3.0),
            lidar_rotation=tuple(turned.as_quat()),
        )
    )
    assert asked["imu"].rate == 400.0
    assert asked["gps"].rate == 2.0
    np.testing.assert_allclose(asked["T_imu_lidar"][:3, :3], turned.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(asked["T_imu_lidar"][:3, 3], [1.0, 2.0, 3.0])
    assert arguments(sensors=SensorOptions(imu_rate=0.0))["imu"] is None


def test_error_options(arguments):
    inertial = {
        "gyro_noise": 1e-3,
        "accel_noise": 2e-3,
        "gyro_bias_walk": 3e-5,
        "accel_bias_walk": 4e-4,
        "gyro_bias_sigma": 0.0,
        "accel_bias_sigma": 0.05,
        "time_offset": 0.02,
    }
    errors = ErrorOptions(
        range_noise=0.07, gps_noise=1.5, gps_multipath=0.0, gps_outage_every=60.0, **inertial
    )
    asked = arguments(sensors=SensorOptions(gps_rate=1.0), errors=errors)
    for name, value in inertial.items():
        assert getattr(asked["imu"], name) == value
    assert asked["gps"].noise == (1.5, 1.5, 1.5)
    assert asked["gps"].multipath == 0.0
    assert asked["gps"].outage_every == 60.0
    assert float(asked["sensor"].ranging.sigma) == pytest.approx(0.07)
    assert asked["sensor"].beams == 16


def test_every_option_has_a_flag(cli):
    text = cli("sim", "--help").out
    for options in (MotionOptions(), SensorOptions(), ErrorOptions()):
        for name in vars(options):
            assert f"--{name.replace('_', '-')}" in text


# -- bad input


def _refused(done, tmp_path, status=2):
    """Return the one sentence; nothing was written."""
    assert done.status == status
    assert done.out == ""
    assert "Traceback" not in done.err
    assert list(tmp_path.iterdir()) == []
    (sentence,) = done.err.splitlines()
    assert "unexpected" not in sentence
    return sentence


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("moon",), "world 'moon' is unknown; choose one of: city,"),
        (("room", "--sensor", "sonar"), "sensor 'sonar' is unknown; choose one of: "),
        (("room", "--sensor", "sonar", "--range-noise", 0), "sensor 'sonar' is unknown"),
        (("room", "--duration", 0), "a duration of 0.0 s holds no scan; give at least 0.1 s"),
        (("room", "--duration", -3), "a duration of -3.0 s holds no scan"),
        (("room", "--duration", "nan"), "a duration of nan s holds no scan"),
        (("room", "--imu-rate", -1), "--imu-rate: -1.0 is impossible"),
        (("room", "--gps-rate", "inf"), "--gps-rate: inf is impossible"),
        (("room", "--range-noise", -1), "--range-noise: -1.0 is impossible"),
        (("room", "--duration", 0.1, "--gyro-noise", -1), "gyro_noise: -1.0 is impossible"),
        (("room", "--seed", -1), "--seed: -1 is impossible"),
        (("room", "--lidar-rotation", 1, 1, 0, 0), "--lidar-rotation must be a unit quaternion"),
        (("room", "--format", "ros1"), "a ros1 recording is .bag; choose another path or format."),
    ],
)
def test_impossible_requests(cli, tmp_path, words, said):
    assert said in _refused(cli("sim", *words, "--out", tmp_path / "a"), tmp_path)


@pytest.mark.parametrize(
    ("name", "wanted", "said"),
    [
        ("a.bag", "native", "a native recording is a folder"),
        ("a.mcap", "ros2-sqlite3", "is .db3 or a folder without an ending"),
        ("a.bag", "ros2-mcap", "is .mcap or a folder without an ending"),
    ],
)
def test_a_path_that_does_not_fit_the_format(cli, tmp_path, name, wanted, said):
    done = cli("sim", "room", "--format", wanted, "--out", tmp_path / name)
    assert said in _refused(done, tmp_path)


def test_no_output_given(cli, tmp_path):
    assert "--out" in cli("sim", "room").err


@pytest.mark.parametrize("name", ["a", "a.bag", "a.mcap", "a.db3"])
def test_an_output_that_exists_is_kept(cli, tmp_path, name):
    (tmp_path / name).write_text("years of work")
    done = cli("sim", "room", "--out", tmp_path / name)
    assert done.status == 2
    assert done.err.splitlines()[-1] == (
        f"lio-jax: {tmp_path / name}: exists already; choose another path or allow overwriting (--overwrite)."
    )
    assert (tmp_path / name).read_text() == "years of work"


def test_a_truth_that_exists_is_kept(cli, tmp_path):
    (tmp_path / "a.truth.tum").write_text("years of work")
    done = cli("sim", "room", "--out", tmp_path / "a.bag")
    assert done.status == 2
    assert "a.truth.tum: exists already" in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["a.truth.tum"]


def test_a_folder_that_is_no_recording_is_never_overwritten(cli, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "draft.txt").write_text("years of work")
    for words in ((), ("--format", "ros2-mcap")):
        done = cli("sim", "room", *words, "--out", tmp_path / "thesis", "--overwrite")
        assert done.status == 2
        assert "so it is not overwritten" in done.err
    assert (tmp_path / "thesis" / "draft.txt").read_text() == "years of work"


def test_trajectories_that_cannot_be_followed(cli, tmp_path, native):
    poses = read_tum(native / "truth.tum").poses
    folder = tmp_path / "in"
    folder.mkdir()
    write_kitti_poses(folder / "04.txt", poses)
    out = tmp_path / "out"
    out.mkdir()

    def ask(trajectory, *words):
        done = cli("sim", "room", "--trajectory", trajectory, *words, "--out", out / "a")
        assert list(out.iterdir()) == []
        return done

    missing = ask(folder / "nothing.tum")
    assert missing.status == 1
    assert "nothing.tum: there is no such file or folder" in missing.err
    assert "04.txt: has no time stamps" in _refused(ask(folder / "04.txt"), out)
    assert "a trajectory itself says how it moves" in _refused(ask(native, "--moving-start"), out)
    assert "ends after 0.30 s, before the wanted 5.0 s" in _refused(ask(native, "--duration", 5), out)


@pytest.mark.parametrize("size", [1_000, 60_000])
@pytest.mark.parametrize("name", ["a", "a.bag", "a.mcap", "a.db3"])
def test_a_disk_that_fills_up(cli, tmp_path, native, name, size):
    with full_disk_after(size):
        done = cli(*WORDS, "--out", tmp_path / name)
    sentence = _refused(done, tmp_path, status=1)
    assert sentence.startswith(f"lio-jax: {tmp_path / 'a'}")
    assert "cannot be written (" in sentence
    assert sentence.endswith("nothing was left there; check its permissions and the free space.")


@pytest.mark.parametrize("name", ["a", "a.bag", "a.mcap", "a.db3"])
def test_ctrl_c(cli, tmp_path, monkeypatch, native, name):
    original = command.SimulatedSequence.scans

    def scans(self, start=0, count=None):
        yield from original(self, 0, 1)
        assert any(tmp_path.iterdir())
        raise KeyboardInterrupt

    monkeypatch.setattr(command.SimulatedSequence, "scans", scans)
    done = cli(*WORDS, "--out", tmp_path / name)
    assert _refused(done, tmp_path, status=1) == "lio-jax: interrupted before the job was done."


def test_an_output_below_a_file(cli, tmp_path, native):
    (tmp_path / "file").touch()
    done = cli(*WORDS, "--out", tmp_path / "file" / "a.bag")
    assert done.status == 1
    assert len(done.err.splitlines()) == 1
    assert "Not a directory" in done.err
