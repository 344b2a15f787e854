"""``lio-jax calibrate-imu``: densities from a recording at rest, or one sentence why not."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from lio_jax.settings.settings import Settings, load_settings
from tests.commands.conftest import Cli

RATE = 50
EPOCH_NS = 1_700_000_000_000_000_000
GYRO, ACCEL, GYRO_WALK, ACCEL_WALK = 2e-3, 2e-2, 2e-4, 2e-3


def write_imu(path: Path, seconds: float, **changed: np.ndarray) -> Path:
    """Write a native imu.npz of an IMU at rest."""
    rng = np.random.default_rng(0)
    count = round(seconds * RATE)

    def noise(white: float, walk: float) -> np.ndarray:
        bias = np.cumsum(rng.normal(0, walk / RATE**0.5, (count, 3)), axis=0)
        return bias + rng.normal(0, white * RATE**0.5, (count, 3))

    arrays = {
        "stamp_ns": EPOCH_NS + np.arange(count) * (1_000_000_000 // RATE),
        "gyro": noise(GYRO, GYRO_WALK if seconds > 600 else 0.0),
        "accel": noise(ACCEL, ACCEL_WALK if seconds > 600 else 0.0) + np.array([0.3, 0.1, 9.8]),
    }
    np.savez(path, **{**arrays, **changed})
    return path


def moved(seconds: float, start: float) -> np.ndarray:
    """Return rates at rest but for a turn of 2 s."""
    gyro = np.random.default_rng(1).normal(0, 0.01, (round(seconds * RATE), 3))
    gyro[round(start * RATE) : round((start + 2) * RATE), 2] += 0.5
    return gyro


@pytest.fixture(scope="module")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # the walk of half an hour stays below what counts as motion
    return write_imu(tmp_path_factory.mktemp("rest") / "imu.npz", 1800)


def test_densities_are_printed_written_and_drawn(cli: Cli, tmp_path: Path, long_recording: Path) -> None:
    out, plot = tmp_path / "new" / "imu.yaml", tmp_path / "imu.png"
    done = cli("calibrate-imu", long_recording, "--out", out, "--plot", plot)
    assert (done.status, done.err) == (0, "")
    assert "90000 samples at 50.0 Hz, 1800 s at rest" in done.out
    for words in ("rad/s/sqrt(Hz)", "m/s^2/sqrt(Hz)", "rad/s^2/sqrt(Hz)", "m/s^3/sqrt(Hz)"):
        assert words in done.out
    imu = load_settings(out).values["imu"]
    assert imu["gyro_noise"] == pytest.approx(GYRO, rel=0.03)
    assert imu["accel_noise"] == pytest.approx(ACCEL, rel=0.03)
    assert imu["gyro_bias_walk"] == pytest.approx(GYRO_WALK, rel=0.35)
    assert imu["accel_bias_walk"] == pytest.approx(ACCEL_WALK, rel=0.35)
    assert plot.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == ["imu.png", "imu.yaml"]


def test_the_file_sets_nothing_but_the_imus_noise(cli: Cli, tmp_path: Path, long_recording: Path) -> None:
    out = tmp_path / "imu.yaml"
    cli("calibrate-imu", long_recording, "--out", out)
    settings = load_settings(out)
    assert settings.recipe == Settings().recipe
    assert settings.config == Settings().config
    assert {path.rsplit(".", 1)[0] for path in settings.given} == {"params.imu"}
    assert len(settings.given) == 4


def test_too_short_for_the_walk_writes_the_white_noise_only(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "imu.yaml"
    done = cli("calibrate-imu", write_imu(tmp_path / "imu.npz", 60), "--out", out)
    assert done.status == 0
    assert done.err.count("too short to see the bias random walk") == 2
    assert set(yaml.safe_load(out.read_text())["params"]["imu"]) == {"gyro_noise", "accel_noise"}


def test_a_recording_that_moves_is_refused(cli: Cli, tmp_path: Path) -> None:
    data = write_imu(tmp_path / "imu.npz", 60, gyro=moved(60, 40))
    done = cli("calibrate-imu", data, "--out", tmp_path / "imu.yaml")
    assert done.status == 1
    assert done.err.splitlines()[-1] == (
        f"lio-jax: {data}: the IMU moves at 40 s from its first sample; give a recording at rest, or leave "
        "out a restless start with --skip SECONDS."
    )
    assert not (tmp_path / "imu.yaml").exists()


def test_a_restless_start_can_be_skipped(cli: Cli, tmp_path: Path) -> None:
    data = write_imu(tmp_path / "imu.npz", 60, gyro=moved(60, 3))
    assert cli("calibrate-imu", data, "--out", tmp_path / "a.yaml").status == 1
    done = cli("calibrate-imu", data, "--out", tmp_path / "b.yaml", "--skip", "6")
    assert done.status == 0
    assert "54 s at rest" in done.out


def test_too_few_samples_are_refused(cli: Cli, tmp_path: Path) -> None:
    data = write_imu(tmp_path / "imu.npz", 20)
    done = cli("calibrate-imu", data, "--out", tmp_path / "imu.yaml")
    assert done.status == 1
    assert "20.0 s of IMU samples without a gap are too short, at least 30 s" in done.err
    assert not (tmp_path / "imu.yaml").exists()


def test_more_skipped_than_there_is_is_refused(cli: Cli, tmp_path: Path) -> None:
    data = write_imu(tmp_path / "imu.npz", 60)
    done = cli("calibrate-imu", data, "--out", tmp_path / "imu.yaml", "--skip", "100")
    assert done.status == 1
    assert "0.0 s of IMU samples without a gap after the first 100 s" in done.err


def test_the_longest_stretch_without_a_gap_is_used(cli: Cli, tmp_path: Path) -> None:
    stamps = EPOCH_NS + np.arange(3000) * 20_000_000
    stamps[1000:] += 10_000_000_000
    data = write_imu(tmp_path / "imu.npz", 60, stamp_ns=stamps)
    done = cli("calibrate-imu", data, "--out", tmp_path / "imu.yaml")
    assert done.status == 0
    assert "2000 samples at 50.0 Hz, 40 s at rest" in done.out
    assert "gap(s)" in done.err


def test_a_recording_without_imu_is_refused(cli: Cli, tmp_path: Path) -> None:
    from lio_jax.data.native_writer import write_native
    from tests.data.test_native import scans

    write_native(tmp_path / "drive", scans(2))
    done = cli("calibrate-imu", tmp_path / "drive", "--out", tmp_path / "imu.yaml")
    assert done.status == 1
    assert f"{tmp_path / 'drive'}: holds no IMU samples" in done.err


def test_a_native_recordings_samples_are_taken(cli: Cli, tmp_path: Path) -> None:
    from lio_jax.data.native_writer import write_native
    from lio_jax.data.sequence import ImuData
    from tests.data.test_native import scans

    with np.load(write_imu(tmp_path / "imu.npz", 40)) as file:
        imu = ImuData(file["stamp_ns"], file["gyro"], file["accel"])
    write_native(tmp_path / "drive", scans(2), imu=imu)
    done = cli("calibrate-imu", tmp_path / "drive", "--out", tmp_path / "imu.yaml")
    assert done.status == 0
    assert "2000 samples" in done.out


def test_a_dead_sensor_is_refused(cli: Cli, tmp_path: Path) -> None:
    data = write_imu(tmp_path / "imu.npz", 40, gyro=np.zeros((2000, 3)))
    done = cli("calibrate-imu", data, "--out", tmp_path / "imu.yaml")
    assert done.status == 1
    assert "the gyroscope shows no white noise" in done.err
    assert not (tmp_path / "imu.yaml").exists()


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04broken"])
def test_a_broken_file_is_one_sentence(cli: Cli, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "imu.npz").write_bytes(content)
    done = cli("calibrate-imu", tmp_path / "imu.npz", "--out", tmp_path / "imu.yaml")
    assert done.status == 1
    assert (
        done.err
        == f"lio-jax: {tmp_path / 'imu.npz'}: cannot be read as an .npz file; give a native imu.npz.\n"
    )


def test_a_file_without_rates_names_what_is_missing(cli: Cli, tmp_path: Path) -> None:
    np.savez(tmp_path / "imu.npz", stamp_ns=np.arange(3))
    done = cli("calibrate-imu", tmp_path / "imu.npz", "--out", tmp_path / "imu.yaml")
    assert done.status == 1
    assert "holds no gyro, accel" in done.err


def test_columns_of_different_lengths_are_named(cli: Cli, tmp_path: Path) -> None:
    data = write_imu(tmp_path / "imu.npz", 40, gyro=np.zeros((7, 3)))
    done = cli("calibrate-imu", data, "--out", tmp_path / "imu.yaml")
    assert done.status == 1
    assert "gyro (7, 3) and accel (2000, 3) must be (2000, 3)" in done.err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--out", "imu.txt"), "ends in .yaml"),
        (("--out", "imu.yaml", "--plot", "imu.jpg"), "ends in .png"),
        (("--out", "imu.yaml", "--skip", "-1"), "--skip must be 0 or more"),
    ],
)
def test_wrong_usage_is_status_2(cli: Cli, tmp_path: Path, words: tuple[str, ...], complaint: str) -> None:
    done = cli("calibrate-imu", tmp_path / "imu.npz", *words)
    assert done.status == 2
    assert complaint in done.err


def test_degrees_and_g_with_a_rate_are_read(cli: Cli, tmp_path: Path) -> None:
    with np.load(write_imu(tmp_path / "imu.npz", 40)) as file:
        gyro, accel = np.degrees(file["gyro"]), file["accel"] / 9.80665
    np.savez(tmp_path / "raw.npz", rate_hz=50.0, gyro_dps=gyro, accel_g=accel)
    out = tmp_path / "imu.yaml"
    assert cli("calibrate-imu", tmp_path / "raw.npz", "--out", out).status == 0
    assert load_settings(out).values["imu"]["gyro_noise"] == pytest.approx(GYRO, rel=0.05)
    assert load_settings(out).values["imu"]["accel_noise"] == pytest.approx(ACCEL, rel=0.05)
