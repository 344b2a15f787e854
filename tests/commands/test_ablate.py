"""``lio-jax ablate``: from a specification to a table and a page, and what a user may get wrong."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import pytest

from lio_jax.ablation import cluster
from lio_jax.core.files import folder_lock
from tests.ablation.drives import DRIVE, write_spec
from tests.full_disk import full_disk_after

SMOKE = Path(__file__).parents[2] / "configs" / "ablations" / "smoke.yaml"


class Page(HTMLParser):
    """Read a page: its references, its text, and whether its elements are closed."""

    def __init__(self, text):
        super().__init__()
        self.targets, self.words, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.targets += [(tag, value) for name, value in attributes if name in ("href", "src")]
        if tag not in ("meta", "link", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def finished(out):
    return [entry for entry in (out / "tasks").iterdir() if not entry.name.startswith(".")]


def check_page(out):
    text = (out / "report.html").read_text()
    page = Page(text)
    assert page.open == []
    assert "<script" not in text
    for tag, target in page.targets:
        if tag == "link":
            assert target == "data:,"
        elif tag == "img":
            assert target.startswith("data:image/svg+xml;base64,")
        else:
            assert (out / target).exists(), target
    return page


@pytest.mark.long
def test_smoke(cli, tmp_path):
    out = tmp_path / "out"
    done = cli("ablate", SMOKE, "--report", "--out", out)
    assert done.status == 0, done.err
    assert not re.search(r"[\r\x1b]", done.out + done.err)
    assert "16 of 16 runs ended, 0 failed" in done.err
    lines = done.out.splitlines()
    assert lines[0].split()[:3] == ["variant", "runs", "ate.rmse"]
    assert sum("4/4" in line for line in lines) == 4
    assert sum(line.split()[-5:-3] == ["-", "baseline"] for line in lines[1:]) == 1
    assert len(finished(out)) == 16
    page = check_page(out)
    assert len([tag for tag, _ in page.targets if tag == "a"]) == 16
    # error against time, and two parameters
    assert len([tag for tag, _ in page.targets if tag == "img"]) == 3
    before = {entry.name: entry.stat().st_mtime_ns for entry in finished(out)}
    again = cli("ablate", SMOKE, "--out", out)
    assert again.status == 0
    assert "16 runs, 16 done" in again.err
    assert again.out.splitlines()[:5] == lines[:5]
    assert {entry.name: entry.stat().st_mtime_ns for entry in finished(out)} == before


@pytest.mark.long
def test_a_sequence_that_is_not_there_stops_no_other(cli, tmp_path):
    spec = write_spec(
        tmp_path / "spec.yaml",
        name="<b>odd</b> & more",
        grid={"params.map.voxel_size": [0.8]},
        sequences=[DRIVE, {"path": "no<where>"}],
    )
    out = tmp_path / "out"
    done = cli("ablate", spec, "--report", "--out", out)
    assert done.status == 1
    assert f"failed: no<where>, voxel_size=0.8: {tmp_path / 'no<where>'}: no such file or folder" in done.err
    assert done.err.splitlines()[-1] == (
        f"lio-jax: 1 of 2 runs failed ({out / 'failed'} holds the reasons); --retry-failed tries them again."
    )
    assert len(finished(out)) == 1
    page = check_page(out)
    assert "<b>odd</b> & more" in page.words
    assert any("no<where>" in word for word in page.words)
    # left alone, then tried again
    (record,) = (out / "failed").iterdir()
    first = record.stat().st_mtime_ns
    assert cli("ablate", spec, "--out", out).status == 1
    assert record.stat().st_mtime_ns == first
    assert cli("ablate", spec, "--retry-failed", "--out", out).status == 1
    assert record.stat().st_mtime_ns > first


@pytest.mark.long
def test_everything_may_be_kept(cli, tmp_path):
    changes = {"keep": "everything", "grid": {"params.map.voxel_size": [0.8]}}
    out = tmp_path / "out"
    done = cli("ablate", write_spec(tmp_path / "spec.yaml", **changes), "--out", out)
    assert done.status == 0, done.err
    (folder,) = finished(out)
    names = {file.name for file in folder.iterdir()}
    assert {"map.pcd", "recording.rrd", "states.npz", "trajectory.tum", "run.log", "result.parquet"} <= names
    assert "per scan" in (folder / "run.log").read_text()
    assert json.loads((folder / "metrics.json").read_text())["ate"]["rmse"] > 0


def test_an_empty_grid(cli, tmp_path):
    done = cli("ablate", write_spec(tmp_path / "spec.yaml", grid={}), "--out", tmp_path / "out")
    assert done.status == 2
    assert "grid: is empty" in done.err
    assert not (tmp_path / "out").exists()


def test_an_unknown_parameter(cli, tmp_path):
    spec = write_spec(tmp_path / "spec.yaml", grid={"params.map.voxelsize": [1.0]})
    done = cli("ablate", spec, "--out", tmp_path / "out")
    assert done.status == 2
    (line,) = done.err.splitlines()
    assert line.startswith(f"lio-jax: {spec}")
    assert "'params.map.voxelsize'; did you mean 'params.map.voxel_size'?" in line


def test_a_scheduler_that_is_not_there(cli, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_ANSWER_S", 1)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    spec = write_spec(tmp_path / "spec.yaml")
    for wrong in (address, "nonsense://x"):
        done = cli("ablate", spec, "--scheduler", wrong, "--out", tmp_path / "out")
        assert done.status == 2
        assert f"--scheduler {wrong}: no dask scheduler answers there; start one" in done.err
        assert "Traceback" not in done.err


@pytest.mark.long
def test_a_running_scheduler(cli, tmp_path):
    from distributed import LocalCluster

    spec = write_spec(tmp_path / "spec.yaml", grid={"params.map.voxel_size": [0.8, 1.2]})
    with LocalCluster(
        n_workers=1, threads_per_worker=2, host="127.0.0.1", dashboard_address=None, processes=True
    ) as running:
        address = running.scheduler_address
        done = cli("ablate", spec, "--scheduler", address, "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert len(finished(tmp_path / "out")) == 2


def test_two_commands_on_one_folder(cli, tmp_path):
    out = tmp_path / "out"
    (out / "tasks").mkdir(parents=True)
    with folder_lock(out):
        done = cli("ablate", write_spec(tmp_path / "spec.yaml"), "--out", out)
    assert done.status == 2
    assert f"{out}: another lio-jax ablate is at work there" in done.err


def test_a_folder_of_something_else(cli, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    done = cli("ablate", write_spec(tmp_path / "spec.yaml"), "--out", tmp_path / "out")
    assert done.status == 2
    assert "holds something else than an ablation" in done.err


@pytest.mark.long
def test_a_full_disk(tmp_path):
    """Workers take the limit over from the command, and cut off the programs that they keep."""
    programs = shutil.copytree(os.environ["LIO_JAX_CACHE"], tmp_path / "programs")
    code = (
        "import sys\n"
        "from lio_jax.cli import main\n"
        "from tests.full_disk import full_disk_after\n"
        "with full_disk_after(700):\n"
        "    sys.exit(main(sys.argv[1:]))\n"
    )
    out = tmp_path / "out"
    spec = write_spec(tmp_path / "spec.yaml", grid={"params.map.voxel_size": [0.8]})
    done = subprocess.run(
        [sys.executable, "-c", code, "ablate", str(spec), "--out", str(out)],
        cwd=SMOKE.parents[2],
        env={**os.environ, "LIO_JAX_CACHE": str(programs), "JAX_COMPILATION_CACHE_DIR": str(programs)},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"lio-jax: {out}")
    assert "cannot be written (File too large), nothing was left there" in last
    assert "Traceback" not in done.stderr
    assert finished(out) == []


def test_a_specification_on_a_full_disk(cli, tmp_path):
    spec = write_spec(tmp_path / "spec.yaml")
    spec.write_text(spec.read_text() + "# as long as notes may be\n" * 400)
    with full_disk_after(4000):
        done = cli("ablate", spec, "--out", tmp_path / "out")
    assert done.status == 1
    assert f"{tmp_path / 'out' / 'spec.yaml'}: cannot be written" in done.err


def test_ctrl_c(tmp_path):
    spec = write_spec(
        tmp_path / "spec.yaml", grid={"params.map.voxel_size": [0.7 + 0.01 * n for n in range(90)]}
    )
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "lio_jax.cli", "ablate", str(spec), "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a terminal sends the signal to the workers as well
        start_new_session=True,
        # a shell makes what it starts in the background ignore the signal
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline and process.poll() is None:
            if (out / "tasks").is_dir() and finished(out):
                break
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 1, err
    assert "Traceback" not in err
    count = len(finished(out))
    assert 0 < count < 90
    assert re.fullmatch(
        rf"lio-jax: interrupted: {count} of 90 runs are done; the same command goes on from there\.",
        err.splitlines()[-1],
    )
