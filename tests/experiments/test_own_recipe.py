"""A recipe in a user's own file works wherever a recipe of the package does."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
import yaml

from lio_jax import (
    ImuModel,
    SimulatedSequence,
    gradient,
    imu_feed,
    recipe_of,
    recipe_settings,
    run_ablation,
    scan_inputs,
    settings_for,
)
from lio_jax.cli import main
from lio_jax.core.errors import UsageError
from lio_jax.recipes import recipe_named
from lio_jax.recipes.transforms import batched

FILE = Path(__file__).resolve().parents[2] / "experiments" / "own_recipe.py"
NAME = f"{FILE}:OwnRecipe"
SMALL = ("config.lidar.points=1024", "config.map.capacity=8192", "config.lidar.buckets=[4096]")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Return a recording of two seconds along a street."""
    path = tmp_path_factory.mktemp("own") / "street"
    words = "sim street --sensor vlp16 --duration 2 --seed 1 --out"
    assert main([*words.split(), str(path)]) == 0
    return path


def test_the_file_is_short():
    assert len(FILE.read_text().splitlines()) < 100


def test_it_runs_with_its_settings_loops_and_a_report(drive, tmp_path):
    out = tmp_path / "out"
    sets = ["--set", *SMALL, "params.registration.kernel=0.3", "config.backend.loops=true"]
    assert main(["run", str(drive), "--recipe", NAME, *sets, "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    # the truth is the simulator's; a straight-line start of 2 s
    assert metrics["ate"]["rmse"] < 0.05
    assert metrics["backend"] is not None
    settings = yaml.safe_load((out / "config.yaml").read_text())
    assert settings["recipe"] == NAME
    assert settings["params"]["registration"]["kernel"] == 0.3
    assert "knn" not in settings["params"]
    assert "OwnRecipe" in (out / "report.html").read_text()
    again = tmp_path / "again"
    plain = ["config.output.report=false", "config.output.plot=false", "config.output.recording=false"]
    assert (
        main(["run", str(drive), "--recipe", str(out / "config.yaml"), "--set", *plain, "--out", str(again)])
        == 0
    )
    assert (again / "odometry.tum").read_bytes() == (out / "odometry.tum").read_bytes()


@pytest.mark.long
def test_it_is_tuned(drive, tmp_path):
    words = ["--recipe", NAME, "--set", *SMALL, "--params", "lidar.range_sigma", "--objective", "pose"]
    assert main(["tune", str(drive), *words, "--iterations", "2", "--out", str(tmp_path / "tuned")]) == 0
    tuned = yaml.safe_load((tmp_path / "tuned" / "tuned.yaml").read_text())
    assert tuned["recipe"] == NAME
    assert tuned["params"]["lidar"]["range_sigma"] > 0


def test_it_is_ablated(drive, tmp_path):
    spec = {
        "recipe": NAME,
        "sequences": [{"path": str(drive), "scans": 5}],
        "grid": {"params.map.voxel_size": [0.8, 1.0]},
        "metrics": ["ate.rmse"],
    }
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump(spec))
    compared = run_ablation(tmp_path / "spec.yaml", tmp_path / "out")
    assert len(compared.rows) == 2
    assert not compared.failures


@pytest.mark.long
def test_its_gradient_is_the_slope():
    sequence = SimulatedSequence("street", "vlp16", 2.0, seed=1, imu=ImuModel())
    settings = recipe_settings(NAME)
    noise, step = settings.values["imu"]["gyro_noise"], 1e-3

    def at(value):
        moved = settings.with_value("params.imu.gyro_noise", value, "tried")
        return gradient(sequence, ["imu.gyro_noise"], "pose", moved)

    above, below = at((1 + step) * noise), at((1 - step) * noise)
    # by the logarithm of the noise
    slope = (above.value - below.value) / (2 * step)
    assert at(noise).gradient["imu.gyro_noise"] == pytest.approx(slope, rel=0.02)


@pytest.mark.long
def test_it_batches():
    sequence = SimulatedSequence("street", "vlp16", 0.2, seed=1, imu=ImuModel())
    settings, _ = settings_for(sequence, recipe_settings(NAME))
    imu, _ = imu_feed(sequence, settings)
    first = next(iter(scan_inputs(settings, sequence.scans(), imu)))
    both = batched(recipe_of(settings))
    params = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), settings.params())
    scan, samples, before = jax.tree.map(jnp.asarray, (first.scan, first.imu, first.before))
    state, _ = both.step(params, both.init(params, before), scan, samples)
    assert state.nav.T_world_imu.wxyz_xyz.shape == (2, 7)


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        ("x = 1", "Missing", "holds no recipe 'Missing'"),
        ("import nothing_like_this", "Mine", "cannot be imported"),
        ("from lio_jax import Recipe\nclass Mine(Recipe):\n    pass", "Mine", "lacks init and step"),
    ],
)
def test_a_file_without_a_recipe_gets_one_sentence(tmp_path, text, name, words):
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(UsageError, match=words):
        recipe_named(f"{path}:{name}")


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(UsageError, match=r"none\.py: the recipe's file cannot be read"):
        recipe_named(f"{tmp_path}/none.py:Mine")
