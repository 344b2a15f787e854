"""SIGKILL of workers and of the whole command, at random moments: nothing is lost, nothing is half there."""

import json
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from tests.ablation import trivial

pytestmark = pytest.mark.long

KILLS_OF_WORKERS, KILLS_OF_COMMANDS = 15, 6


def results(root):
    """Return the contents of every finished result, with what identifies it among later ones."""
    tasks = root / "tasks"
    found = {}
    for entry in tasks.iterdir() if tasks.is_dir() else ():
        if not entry.name.startswith("."):
            assert {file.name for file in entry.iterdir()} == {"first.txt", "second.txt"}
            for file in entry.iterdir():
                assert file.read_text() == trivial.content(entry.name)
            found[entry.name] = (entry.stat().st_ino, entry.stat().st_mtime_ns)
    return found


def check_all_done(root):
    assert set(results(root)) == {task.key for task in trivial.tasks()}
    assert not [entry for entry in (root / "tasks").iterdir() if entry.name.startswith(".")]
    failed = root / "failed"
    assert not failed.exists() or not list(failed.iterdir())


def worker_processes(of):
    try:
        children = of.children(recursive=True)
        return [child for child in children if any("spawn_main" in word for word in child.cmdline())]
    except psutil.NoSuchProcess:
        return []


def test_workers_are_killed(tmp_path):
    """The command continues after a worker's death: the run of that worker starts again."""
    draw = random.Random(1)
    killed, over = [], threading.Event()

    def kill_now_and_then():
        while len(killed) < KILLS_OF_WORKERS and not over.is_set():
            over.wait(draw.uniform(0.05, 0.6))
            if running := worker_processes(psutil.Process()):
                victim = draw.choice(running)
                victim.kill()
                killed.append(victim.pid)

    killer = threading.Thread(target=kill_now_and_then, daemon=True)
    root = tmp_path / "out"
    # before the first worker is ready as well as in the middle of its runs
    killer.start()
    trivial.run(root)
    over.set()
    killer.join()
    assert len(killed) == KILLS_OF_WORKERS
    before = results(root)
    trivial.run(root)
    check_all_done(root)
    # none of those that were done is done again
    assert {key: results(root)[key] for key in before} == before


def test_commands_are_killed(tmp_path):
    """The command is started again each time; finished runs stay unchanged until the last one is done."""
    draw = random.Random(2)
    root = tmp_path / "out"
    before, kills = {}, 0
    while kills < KILLS_OF_COMMANDS:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.ablation.trivial", str(root)],
            cwd=Path(__file__).parents[2],
            stderr=subprocess.DEVNULL,
        )
        workers = []
        deadline = time.monotonic() + draw.uniform(0.2, 5.0)
        while time.monotonic() < deadline and process.poll() is None:
            workers = worker_processes(psutil.Process(process.pid)) or workers
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait()
        kills += 1
        # workers notice that the command is gone
        assert not psutil.wait_procs(workers, timeout=10)[1]
        now = results(root)
        assert {key: now.get(key) for key in before} == before
        before = now
    trivial.run(root)
    now = results(root)
    assert {key: now[key] for key in before} == before
    check_all_done(root)
    assert kills == KILLS_OF_COMMANDS


def test_a_run_that_takes_its_worker_down_each_time(tmp_path):
    """Counts as failed after some tries; what comes after it is done."""
    root = tmp_path / "out"
    trivial.run(root, trivial.poisoned)
    assert set(results(root)) == {task.key for task in trivial.tasks()} - {trivial.POISON}
    (record,) = (root / "failed").iterdir()
    assert record.stem == trivial.POISON
    assert json.loads(record.read_text())["reason"].startswith("the worker process died each time")
