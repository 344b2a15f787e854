"""The built package works outside of the checkout, and a user's script sees its types."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import lio_jax

ROOT = Path(__file__).parents[2]

CONSUMER = """
    import numpy as np

    from lio_jax import ImuModel, Settings, SimulatedSequence, evaluate, imu_feed, settings_for, track
    from lio_jax import Trajectory, __version__

    drive = SimulatedSequence("room", duration_s=1.0, imu=ImuModel())
    settings, notes = settings_for(drive, Settings())
    imu, warnings = imu_feed(drive, settings)
    results = list(track(settings, drive.scans(), imu))
    estimate = Trajectory(np.array([r.stamp_ns for r in results]), np.stack([r.T_world_imu for r in results]))
    error: float = evaluate(estimate, drive.truth()).ate.rmse
    text: str = f"{__version__} {error} {notes} {warnings}"
"""


def called(*words: str, folder: Path, package: Path) -> str:
    """Run a Python command in a folder, with one lio_jax on the path; return what it prints."""
    environment = {**os.environ, "PYTHONPATH": str(package), "MYPYPATH": str(package)}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_version_is_the_distributions():
    assert lio_jax.__version__.split(".")[0].isdigit()
    with pytest.raises(AttributeError, match="nothing_of_this_name"):
        _ = lio_jax.nothing_of_this_name


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the package as its wheel installs it, without the dependencies."""
    pytest.importorskip("build", reason="build is not installed here (extra dev): no wheel is made")
    wheels, target = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("target")
    source = tmp_path_factory.mktemp("source")
    # a build leaves files beside its sources
    listed = subprocess.run(["git", "ls-files", "-z", "lio_jax"], cwd=ROOT, capture_output=True, check=True)
    for name in (*listed.stdout.decode().split("\0"), "pyproject.toml", "README.md", "LICENSE"):
        if name and (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    called("-m", "build", "--wheel", "--no-isolation", "-o", str(wheels), folder=source, package=ROOT)
    (wheel,) = wheels.glob("*.whl")
    options = ("--quiet", "--no-deps", "--no-index", "--disable-pip-version-check", "--target", str(target))
    called("-m", "pip", "install", *options, str(wheel), folder=target, package=target)
    return target


@pytest.mark.long
def test_the_wheel_simulates_and_helps_outside_of_the_checkout(installed, tmp_path):
    where = called("-c", "import lio_jax; print(lio_jax.__file__)", folder=tmp_path, package=installed)
    assert Path(where.strip()).is_relative_to(installed)
    assert (installed / "lio_jax" / "py.typed").is_file()
    assert (installed / "bin" / "lio-jax").is_file()
    run = ("-m", "lio_jax.cli")
    assert "optimize-graph" in called(*run, "--help", folder=tmp_path, package=installed)
    sim = ("sim", "room", "--duration", "0.3", "--out", "room")
    called(*run, *sim, folder=tmp_path, package=installed)
    assert len(list((tmp_path / "room" / "scans").glob("*.npz"))) == 3


@pytest.mark.long
def test_a_users_script_passes_a_strict_type_check(installed, tmp_path):
    script = tmp_path / "consumer.py"
    script.write_text(textwrap.dedent(CONSUMER))
    options = ("--strict", "--follow-imports", "silent", "--cache-dir", str(tmp_path / "cache"))
    called("-m", "mypy", *options, str(script), folder=tmp_path, package=installed)
    script.write_text(script.read_text().replace("error: float", "error: str"))
    with pytest.raises(AssertionError, match="Incompatible types in assignment"):
        called("-m", "mypy", *options, str(script), folder=tmp_path, package=installed)
