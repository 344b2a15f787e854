"""``lio-jax tune`` from end to end on a small simulated recording."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from lio_jax import (
    Schedule,
    Settings,
    UsageError,
    open_sequence,
    train,
    tune,
    with_overrides,
)
from lio_jax.cli import main
from lio_jax.commands.run import resolve_settings
from lio_jax.data.native_writer import write_native
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from lio_jax.tuning.objective_names import SHORT
from lio_jax.tuning.objectives import _SINGLE, objective_named
from lio_jax.tuning.tune import given_tree
from tests.data.foreign_files import LIO_SAM_ROS1

SMALL = [
    "--set",
    "config.lidar.buckets=[4096]",
    "config.imu.buckets=[64]",
    "config.imu.registration_points=1024",
    "config.imu.insertion_points=4096",
    "config.map.capacity=32768",
]
PARAMS = ["--params", "imu.gyro_noise,lidar.range_sigma"]


def test_the_help_lists_the_objectives_that_exist(capsys):
    assert main(["tune", "--help"]) == 0
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    listed = re.search(r"--objective NAME One of (.*?), or a sum such as (\S+);", printed)
    assert set(listed[1].split(", ")) == {*_SINGLE, *SHORT}
    objective_named(listed[2])


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Return two native folders of 25 scans."""
    paths = []
    for seed in (1, 2):
        sequence = SimulatedSequence(duration_s=2.5, beams=16, columns=256, seed=seed, imu=ImuModel())
        paths.append(tmp_path_factory.mktemp("tune") / f"drive{seed}")
        write_native(
            paths[-1],
            sequence.scans(),
            T_imu_lidar=sequence.info.T_imu_lidar,
            imu=sequence.imu(),
            truth=sequence.truth(),
        )
    return [str(path) for path in paths]


def test_a_tuning_leaves_settings_history_and_a_picture(recordings, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["tune", recordings[0], *PARAMS, "--validate", recordings[1], "--out", str(out), *SMALL]
    assert main([*words, "--iterations", "3"]) == 0
    printed = capsys.readouterr().out
    assert "imu.gyro_noise" in printed
    assert "loss on validation" in printed
    held = json.loads((out / "history.json").read_text())["iterates"]
    assert len(held) == 3
    assert held[-1]["value"] < held[0]["value"]
    assert (out / "tuning.png").stat().st_size > 10_000

    tree = yaml.safe_load((out / "tuned.yaml").read_text())
    best = min(held, key=lambda one: one["validation"])
    assert tree["params"]["imu"]["gyro_noise"] == pytest.approx(np.exp(best["x"][0]))
    settings = resolve_settings(str(out / "tuned.yaml"), ())
    assert settings.values["lidar"]["range_sigma"] == pytest.approx(np.exp(best["x"][1]))
    assert settings.config == resolve_settings(None, tuple(SMALL[1:])).config

    assert main([*words, "--iterations", "4"]) == 0
    assert "continuing after 3 evaluations" in capsys.readouterr().err
    assert len(json.loads((out / "history.json").read_text())["iterates"]) == 4

    assert main([*words, "--iterations", "4", "--objective", "ate"]) == 2
    assert "history of another problem, with other objective (it has pose+ranges)" in capsys.readouterr().err


def test_tune_from_python_is_that_of_the_command(recordings, tmp_path):
    words = ["tune", recordings[0], *PARAMS, "--out", str(tmp_path / "command"), *SMALL]
    assert main([*words, "--iterations", "2"]) == 0
    settings = with_overrides(Settings(), SMALL[1:])
    sequences = [open_sequence(Path(recordings[0]))]
    found = tune(sequences, PARAMS[1].split(","), settings=settings, iterations=2, out=tmp_path / "a" / "b")
    written = json.loads((tmp_path / "command" / "history.json").read_text())
    assert json.loads((tmp_path / "a" / "b" / "history.json").read_text()) == written
    assert found.settings == resolve_settings(str(tmp_path / "command" / "tuned.yaml"), ())
    assert found.values["imu.gyro_noise"] == pytest.approx(found.settings.values["imu"]["gyro_noise"])
    low, high = found.intervals["lidar.range_sigma"]
    assert low < found.values["lidar.range_sigma"] < high
    assert found.best in found.history
    with pytest.raises(UsageError, match="--iterations must be 1 or more"):
        tune(sequences, ["imu.*"], settings=settings, iterations=0)


@pytest.mark.long
def test_train_from_python_lowers_the_loss(recordings, tmp_path):
    settings = with_overrides(Settings(), [*SMALL[1:], "params.lidar.range_sigma=0.1"])
    schedule = Schedule(batch=1, epochs=3, rate=0.3)
    judges = [open_sequence(Path(recordings[1]))]
    found = train(
        [open_sequence(Path(recordings[0]))],
        ["lidar.range_sigma"],
        "ranges",
        settings,
        judges,
        segment=20,
        schedule=schedule,
        out=tmp_path / "a" / "b",
    )
    losses = [epoch.validation for epoch in found.epochs]
    assert losses == sorted(losses, reverse=True)
    assert found.best == 2
    assert 0.03 < found.settings.values["lidar"]["range_sigma"] < 0.08


@pytest.mark.parametrize("theirs", [None, LIO_SAM_ROS1], ids=["ours", "theirs"])
def test_the_tuned_file_repeats_what_was_given(tmp_path, theirs):
    ours, params_from, out = tmp_path / "ours.yaml", None, tmp_path / "tuned.yaml"
    ours.write_text("config: {map: {capacity: 32768}}\nparams: {imu: {accel_noise: 0.25}}")
    if theirs:
        params_from = tmp_path / "theirs.yaml"
        params_from.write_text(theirs)
    words = ("params.extrinsics.translation=[0.1,0.2,0.3]", "config.lidar.buckets=[4096]")
    base = resolve_settings(str(ours), words, params_from)
    tuned = {"params.imu.gyro_noise": 1.234567890123e-3, "params.imu.accel_noise": 0.5}
    expected = base
    for path, value in tuned.items():
        expected = expected.with_value(path, value, "test")
    out.write_text(yaml.safe_dump(given_tree(expected)))
    assert resolve_settings(str(out), ()) == expected


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (["--params", "map.voxel_size"], ["map.voxel_size", "no derivative"]),
        ([*PARAMS, "--objective", "truth"], ["'truth' is not known", "ate"]),
        ([*PARAMS, "--objective", "ate", "--optimizer", "scoring"], ["scoring", "likelihood"]),
        ([*PARAMS, "--segment", "5"], ["--segment", "20"]),
        ([*PARAMS, "--iterations", "0"], ["--iterations", "1 or more"]),
        ([*PARAMS, "--start", "99"], ["25 scans"]),
    ],
    ids=lambda value: " ".join(value[-2:]),
)
def test_wrong_usage_is_one_sentence(recordings, tmp_path, capsys, changed, words):
    assert main(["tune", recordings[0], *changed, "--out", str(tmp_path / "out"), *SMALL]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert all(word in error for word in words), error
    assert not (tmp_path / "out" / "tuned.yaml").exists()


def test_an_objective_against_truth_wants_truth(recordings, tmp_path, capsys):
    blind = tmp_path / "blind"
    shutil.copytree(recordings[0], blind)
    (blind / "truth.tum").unlink()
    status = main(["tune", str(blind), *PARAMS, "--objective", "ate", "--out", str(tmp_path / "out"), *SMALL])
    assert status == 2
    assert "holds no truth" in capsys.readouterr().err
