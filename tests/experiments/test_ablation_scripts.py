"""The scripts around ablations: the SLURM recipe and the KITTI table."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.run.small_drive import moving, write_kitti

ROOT = Path(__file__).parents[2]


def script(name, *words):
    return subprocess.run(
        [sys.executable, str(ROOT / "experiments" / name), *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.mark.skipif(
    importlib.util.find_spec("dask_jobqueue") is None, reason="dask-jobqueue is not installed"
)
def test_the_script_of_a_slurm_job(tmp_path):
    words = (
        "--partition",
        "night",
        "--cores",
        "4",
        "--memory",
        "8GB",
        "--walltime",
        "02:00:00",
        "--gpus",
        "1",
    )
    spec = ROOT / "configs" / "ablations" / "smoke.yaml"
    done = script(
        *("ablate_on_slurm.py", spec, "--out", tmp_path / "out", *words),
        *("--prologue", "module load python", "--print-script"),
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("#!")
    directives = [line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH")]
    assert {"-p night", "-n 1", "--cpus-per-task=4", "--mem=8G", "-t 02:00:00", "--gres=gpu:1"} <= set(
        directives
    )
    assert lines.index("module load python") < len(lines) - 1
    (worker,) = [line for line in lines if "dask_worker" in line]
    assert worker.startswith(sys.executable)
    # the last one counts
    assert re.findall(r"--nthreads (\d+)", worker)[-1] == "1"
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_kitti_table(tmp_path):
    for name in ("00", "03"):
        write_kitti(tmp_path / "kitti" / "sequences" / name, moving())
    words = ("--sequences", "00", "03", "05", "--json")
    done = script("reproduce_kitti.py", tmp_path / "kitti", "--out", tmp_path / "out", *words)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[0] == f"note: not in {tmp_path / 'kitti' / 'sequences'}: 05"
    table = json.loads(done.stdout.splitlines()[-1])
    assert set(table["default"]) == {"00", "03"}
    row = table["default"]["03"]
    assert row["scan_ms"] > 0
    assert row["translation_percent"] is None
    assert (tmp_path / "out" / "runs" / "report.html").is_file()


def test_a_folder_without_kitti(tmp_path):
    done = script("reproduce_kitti.py", tmp_path, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"reproduce_kitti: {tmp_path}: holds no sequences")
