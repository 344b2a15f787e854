"""Run every system in a process of its own, in turns scan by scan, to separate crashes and memory."""

import importlib
import multiprocessing
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from systems import Pose, System

from lio_jax.data.sequence import LidarScan
from lio_jax.data.trajectory import Trajectory

_PAUSE_S = 0.005
"""Pause before each timed call, s: the thread pool of the previous system can stop spinning."""

_DEADLINE_S = 300.0
"""Time limit for one scan, and for start and compilation, s; a slower system counts as hung."""


@dataclass
class Outcome:
    """The results of one system on one recording."""

    milliseconds: list[float] = field(default_factory=list)
    """Wall-clock time of each scan, ms."""
    cpu_milliseconds: list[float] = field(default_factory=list)
    """CPU time of each scan over all the process's threads, ms; other work on the machine does not count."""
    scan_stamp_ns: list[int] = field(default_factory=list)
    """Start of the scan to which each pose belongs, ns."""
    poses: list[Pose] = field(default_factory=list)
    """T_world_lidar of each pose."""
    failures: list[str] = field(default_factory=list)
    """One sentence for each scan that failed."""
    died: str = ""
    """Why there are no results after some scan; "" if there are."""
    idle_mb: float = 0.0
    """Peak memory before the system is built, MiB: interpreter and this script."""
    peak_mb: float = 0.0
    """Peak memory at the end, MiB."""

    def trajectory(self, offset_ns: int) -> Trajectory:
        """Return the poses, stamped ``offset_ns`` after the starts of their scans."""
        return Trajectory(np.array(self.scan_stamp_ns, np.int64) + offset_ns, np.array(self.poses))


@dataclass(frozen=True)
class Maker:
    """How a worker makes a new system: ``module.function(*arguments, recording)``."""

    module: str
    function: str
    arguments: tuple[Any, ...]

    def build(self, recording: Path) -> System:
        """Import the module here, in the worker, and build the system."""
        system: System = getattr(importlib.import_module(self.module), self.function)(
            *self.arguments, recording
        )
        return system


def run(recording: Path, makers: dict[str, Maker], say: Callable[[str], None]) -> dict[str, Outcome]:
    """Run every system once over a native folder; the first system rotates from scan to scan.

    Args:
        recording: path of the native folder.
        makers: makers by name.
        say: function that takes one line about each system that ends early.
    """
    outcomes = {name: Outcome() for name in makers}
    workers = {name: _Worker(maker, recording) for name, maker in makers.items()}
    try:
        scans = len(list((recording / "scans").glob("*.npz")))
        for name in list(workers):
            _ask(workers, name, "start", outcomes, say)
        for number in range(scans):
            names = list(workers)
            if not names:
                break
            turn = number % len(names)
            for name in names[turn:] + names[:turn]:
                _ask(workers, name, number, outcomes, say)
        for name in list(workers):
            _ask(workers, name, "end", outcomes, say)
    finally:
        for worker in workers.values():
            worker.stop()
    return outcomes


class _Worker:
    """The parent's side of one process."""

    def __init__(self, maker: Maker, recording: Path) -> None:
        # spawned: a forked child would inherit this process's JAX and its threads
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(maker, recording, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, request: int | str) -> dict[str, Any]:
        """Return the worker's answer; EOFError, OSError or TimeoutError when there is none."""
        self.connection.send(request)
        if not self.connection.poll(_DEADLINE_S):
            raise TimeoutError(f"no answer within {_DEADLINE_S:g} s")
        answer: dict[str, Any] = self.connection.recv()
        return answer

    def stop(self) -> str:
        """End the process and return the way in which it ended."""
        self.connection.close()
        self._process.join(2)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
            return "killed"
        code = self._process.exitcode or 0
        return f"signal {-code}" if code < 0 else f"exit status {code}"


def _ask(
    workers: dict[str, _Worker],
    name: str,
    request: int | str,
    outcomes: dict[str, Outcome],
    say: Callable[[str], None],
) -> None:
    outcome = outcomes[name]
    try:
        answer = workers[name].ask(request)
    except (EOFError, OSError) as error:
        reason = workers.pop(name).stop()
        outcome.died = (
            f"ended at {_where(request)}: {error if str(error) else 'its process is gone'} ({reason})"
        )
        say(f"{name}: {outcome.died}")
        return
    if error := answer.get("error"):
        if request == "start":
            workers.pop(name).stop()
            outcome.died = f"did not start: {error}"
            say(f"{name}: {outcome.died}")
        else:
            outcome.failures.append(f"{_where(request)}: {error}")
    if "milliseconds" in answer:
        outcome.milliseconds.append(answer["milliseconds"])
        outcome.cpu_milliseconds.append(answer["cpu_milliseconds"])
    for stamp, pose in answer.get("estimates", ()):
        outcome.scan_stamp_ns.append(stamp)
        outcome.poses.append(pose)
    outcome.idle_mb = answer.get("idle_mb", outcome.idle_mb)
    outcome.peak_mb = answer.get("peak_mb", outcome.peak_mb)


def _where(request: int | str) -> str:
    return f"scan {request}" if isinstance(request, int) else f"the {request}"


def _serve(maker: Maker, recording: Path, connection: Connection) -> None:
    """Answer the parent's requests until it closes the connection."""
    # the output of peers must not mix with the table
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    side = _Side(maker, recording)
    while True:
        try:
            request = connection.recv()
        except EOFError:
            return
        try:
            answer = side.answer(request)
        except Exception as error:  # a peer may raise any exception; the parent reports it
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        connection.send(answer)


class _Side:
    """The worker's side of one process."""

    def __init__(self, maker: Maker, recording: Path) -> None:
        from lio_jax.data.config import DataConfig
        from lio_jax.data.native import NativeSequence

        self._maker, self._recording = maker, recording
        self._sequence = NativeSequence(recording, DataConfig())
        self._system: System
        self._idle_mb = 0.0

    def answer(self, request: int | str) -> dict[str, Any]:
        """Return the answer to a request of the parent."""
        if request == "start":
            self._idle_mb = _peak_mb()
            for first in self._typical():
                self._maker.build(self._recording).warm_up(list(self._sequence.scans(first, 3)))
            self._system = self._maker.build(self._recording)
            return {}
        if request == "end":
            return {"idle_mb": self._idle_mb, "peak_mb": _peak_mb()}
        assert isinstance(request, int)
        return self._register(next(self._sequence.scans(request, 1)))

    def _typical(self) -> list[int]:
        """Return the scans for a warm-up: the first, the smallest and the largest."""
        sizes = [len(scan.points) for scan in self._sequence.scans()]
        last = max(0, len(sizes) - 3)
        return sorted({0, min(int(np.argmin(sizes)), last), min(int(np.argmax(sizes)), last)})

    def _register(self, scan: LidarScan) -> dict[str, Any]:
        prepared = self._system.prepare(scan)
        time.sleep(_PAUSE_S)
        begin, cpu = time.perf_counter(), time.process_time()
        pose = self._system.register(prepared)
        spent, cpu = time.perf_counter() - begin, time.process_time() - cpu
        estimates: list[tuple[int, NDArray[np.float64]]] = [(scan.stamp_ns, np.array(pose, np.float64))]
        # a system that answers late, or not for each scan, states the scans of its poses
        own = getattr(self._system, "estimates", None)
        if own is not None:
            estimates = list(own)
            own.clear()
        return {"milliseconds": 1e3 * spent, "cpu_milliseconds": 1e3 * cpu, "estimates": estimates}


def _peak_mb() -> float:
    """Return this process's largest resident memory, MiB."""
    # not getrusage: its value for a spawned process starts with the parent's
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024
