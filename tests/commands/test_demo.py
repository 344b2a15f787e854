"""``lio-jax demo`` works end to end with nothing but the package."""

import json

from lio_jax.commands import sim
from lio_jax.sim.sequence import SimulatedSequence
from tests.commands.conftest import PLAIN
from tests.commands.test_run_folder import FILES


def test_demo(cli, tmp_path, monkeypatch):
    def shorter(**words):
        return SimulatedSequence(**{**words, "beams": 16, "columns": 512, "duration_s": 4.2, "seed": 1})

    monkeypatch.setattr(sim, "SimulatedSequence", shorter)
    done = cli("demo", "--out", tmp_path / "demo")
    assert done.status == 0, done.err
    assert {entry.name for entry in (tmp_path / "demo").iterdir()} == FILES | {"imu_rate.tum"}
    metrics = json.loads((tmp_path / "demo" / "metrics.json").read_text())
    assert metrics["scans"] == 42
    assert metrics["ate"]["rmse"] < 0.05
    assert "ATE translation" in done.out
    again = cli("demo", "--out", tmp_path / "demo")
    assert again.status == 2
    assert "add --overwrite" in again.err


def test_unknown_option(cli):
    done = cli("demo", *PLAIN)
    assert done.status == 2
