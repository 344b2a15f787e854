"""``lio-jax train`` from end to end: a network in a recipe of one's own, on a small simulated recording."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from lio_jax import ImuModel, SimulatedSequence
from lio_jax.cli import main
from lio_jax.commands.run import resolve_settings
from lio_jax.data.native_writer import write_native

RECIPE = f"{Path(__file__).resolve().parents[2] / 'experiments' / 'learned_noise.py'}:LearnedNoise"
SMALL = [
    "--set",
    "config.lidar.buckets=[4096]",
    "config.imu.buckets=[64]",
    "config.imu.registration_points=512",
    "config.imu.insertion_points=2048",
    "config.map.capacity=16384",
]


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Return a native folder of 40 scans."""
    sequence = SimulatedSequence(duration_s=4.0, beams=16, columns=256, seed=1, imu=ImuModel())
    path = tmp_path_factory.mktemp("train") / "drive"
    write_native(path, sequence.scans(), T_imu_lidar=sequence.info.T_imu_lidar, imu=sequence.imu())
    return str(path)


@pytest.mark.long
def test_a_network_is_trained_and_continued(drive, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["train", drive, "--recipe", RECIPE, "--params", "learned.weights", "--objective", "pose"]
    words += [
        "--segment",
        "20",
        "--batch",
        "1",
        "--rate",
        "0.05",
        "--validate",
        drive,
        "--out",
        str(out),
        *SMALL,
    ]
    assert main([*words, "--epochs", "2"]) == 0
    printed = capsys.readouterr()
    assert "2 pieces, 25 numbers to train" in printed.err
    assert "epoch 2 of 2" in printed.err
    assert "loss on validation" in printed.out
    assert (out / "training.png").stat().st_size > 10_000
    found = resolve_settings(str(out / "trained.yaml"), ())
    start = resolve_settings(RECIPE, tuple(SMALL[1:]))
    assert found.config == start.config
    assert not np.allclose(found.values["learned"]["weights"], start.values["learned"]["weights"])
    assert set(yaml.safe_load((out / "trained.yaml").read_text())["params"]) == {"learned"}

    assert main([*words, "--epochs", "3"]) == 0
    printed = capsys.readouterr()
    assert "continuing after 2 epochs" in printed.err
    assert "of 3 was taken" in printed.out

    assert main(["run", drive, "--recipe", str(out / "trained.yaml"), "--out", str(tmp_path / "run")]) == 0


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (["--segment", "5"], ["--segment", "20"]),
        (["--batch", "0"], ["batch", "1 or more"]),
        (["--rate", "-1"], ["rate", "positive"]),
        (["--params", "learned.bias"], ["learned.bias", "learned.weights"]),
        (["--objective", "ate"], ["holds no truth", "--gt"]),
    ],
    ids=lambda value: " ".join(value[-2:]),
)
def test_wrong_usage_is_one_sentence(drive, tmp_path, capsys, changed, words):
    out = tmp_path / "out"
    given = [
        "train",
        drive,
        "--recipe",
        RECIPE,
        "--params",
        "learned.weights",
        *changed,
        "--out",
        str(out),
        *SMALL,
    ]
    assert main(given) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert all(word in error for word in words), error
    assert not (out / "trained.yaml").exists()
