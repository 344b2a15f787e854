"""Run damaged inputs one after another, keep those that fail, and make them small."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import count, islice
from pathlib import Path
from random import Random
from typing import Any

from experiments.fuzz.edits import Edit
from experiments.fuzz.kinds import KINDS, Kind
from experiments.fuzz.seeds import write_seeds
from experiments.fuzz.verdicts import ACCEPTED, FAILURES, REFUSED, Done, Verdict, judge
from experiments.fuzz.worker import computing_s, resident_bytes

MOST_BYTES = 2 << 30
"""Memory that a command may take beyond what its process held before, bytes."""
SILENCE_S = 20.0
"""Computing time after which a command that has printed nothing further counts as hanging, s."""
COMPILING_SILENCE_S = 80.0
"""The same for a command that first compiles its programs, on one core, s."""
_LONGEST_WAIT_S = 120.0
"""Time after which it counts as hanging even if it computed less, s: a busy machine gives it a share only."""
_LOOK_S = 0.02
_MOST_KEPT = 4 << 30
"""Memory of a worker after which it is replaced before its next command, bytes."""
_COMPILING_S = 600.0
"""Both times for the commands that make the seeds, s: they compile programs."""


class Worker:
    """A process that runs commands; it is started anew when one of them had to be ended."""

    def __init__(self, work: Path) -> None:
        self._work = work
        self._process: subprocess.Popen[str] | None = None

    def run(self, words: list[str], allowed: Path, silence_s: float = SILENCE_S) -> Done:
        """Run one command, which may write to the folder ``allowed`` only.

        Args:
            words: of the command line.
            allowed: the folder.
            silence_s: computing time after which the command hangs if it has printed nothing, s.
        """
        process = self._started()
        files = {name: self._work / f"worker.{name}" for name in ("out", "err")}
        before = resident_bytes(process.pid)
        if before > _MOST_KEPT:
            # compiled programs pile up
            self.close()
            process = self._started()
            before = 0
        for path in files.values():
            path.write_bytes(b"")
        assert process.stdin is not None
        assert process.stdout is not None
        job = {"words": words, "allowed": str(allowed), **{name: str(path) for name, path in files.items()}}
        try:
            process.stdin.write(json.dumps(job) + "\n")
            process.stdin.flush()
            ended = self._wait(process, list(files.values()), before, silence_s)
            line = "" if ended else process.stdout.readline()
        except BrokenPipeError:
            ended, line = "", ""
        report: dict[str, Any] = json.loads(line) if line else {}
        if not report:
            self.close()
        out, err = (path.read_text(errors="replace") for path in files.values())
        return Done(
            report.get("status"),
            out,
            err,
            "" if report else ended or "died",
            tuple(report.get("outside", ())),
            report.get("grown", 0),
        )

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            # caches, settings and temporary files of the libraries stay within the campaign's folder
            own = {
                "LIO_JAX_CACHE": "cache",
                "HOME": "home",
                "TMPDIR": "temporary",
                "MPLCONFIGDIR": "temporary/matplotlib",
            }
            for folder in own.values():
                (self._work / folder).mkdir(parents=True, exist_ok=True)
            places = {name: str(self._work / folder) for name, folder in own.items()}
            single = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
            root = Path(__file__).resolve().parents[2]
            self._process = subprocess.Popen(
                [sys.executable, "-m", "experiments.fuzz.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                cwd=root,
                env={
                    **os.environ,
                    **places,
                    "PYTHONPATH": str(root),
                    "JAX_PLATFORMS": "cpu",
                    "XLA_FLAGS": single,
                    "OMP_NUM_THREADS": "1",
                },
            )
            # the libraries are imported now, which is no time of the first command
            assert self._process.stdout is not None
            self._process.stdout.readline()
        return self._process

    def _wait(
        self, process: subprocess.Popen[str], outputs: list[Path], before: int, silence_s: float
    ) -> str:
        """Wait for the report; return why the command had to be ended, "" if it had not."""
        import select

        sizes, changed, computed = -1, 0.0, 0.0
        longest_s = max(silence_s, _LONGEST_WAIT_S)
        while True:
            readable, _, _ = select.select([process.stdout], [], [], _LOOK_S)
            if readable:
                return ""
            if process.poll() is not None:
                return "died"
            if resident_bytes(process.pid) - before > MOST_BYTES:
                return self._end(process, "memory")
            now = sum(path.stat().st_size for path in outputs)
            if now != sizes:
                sizes, changed, computed = now, time.monotonic(), computing_s(process.pid)
            elif time.monotonic() - changed > longest_s or computing_s(process.pid) - computed > silence_s:
                return self._end(process, "hang")

    @staticmethod
    def _end(process: subprocess.Popen[str], why: str) -> str:
        process.send_signal(signal.SIGKILL)
        process.wait()
        return why


@dataclass
class Failure:
    """An input that the program does not answer as it should."""

    kind: str
    words: tuple[str, ...]
    """The command, with {in} and {out} in place of folders."""
    edits: list[Edit]
    verdict: str
    evidence: str
    count: int = 1
    """How many inputs of the campaign failed in this way."""

    def to_json(self) -> str:
        """Return the text from which :func:`failure_from_json` makes the input again."""
        return json.dumps(asdict(self), indent=1)


def failure_from_json(text: str) -> Failure:
    """Return a failure that an earlier campaign kept."""
    held = json.loads(text)
    edits = [Edit(edit["file"], edit["change"], tuple(edit["given"])) for edit in held.pop("edits")]
    return Failure(**{**held, "words": tuple(held["words"])}, edits=edits)


@dataclass
class Campaign:
    """The counts of a campaign and its failures, each way of failing once."""

    verdicts: dict[str, Counter[str]] = field(default_factory=dict)
    failures: dict[str, Failure] = field(default_factory=dict)
    seconds: float = 0.0

    def table(self) -> str:
        """Return the counts by kind of input, and a line for each way of failing."""
        columns = ("inputs", ACCEPTED, REFUSED, *FAILURES)
        rows = [("kind", *columns)]
        total: Counter[str] = Counter()
        for kind, counts in self.verdicts.items():
            total += counts
            rows.append((kind, *(str(counts[column]) for column in columns)))
        rows.append(("all", *(str(total[column]) for column in columns)))
        widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))]
        lines = [
            "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
        ]
        lines += [
            f"{failure.count:4d} x {failure.verdict} ({failure.kind}): {failure.evidence}"
            for failure in self.failures.values()
        ]
        return "\n".join([*lines, f"{total['inputs']} inputs in {self.seconds:.0f} s"])


class Trial:
    """Makes inputs out of seeds, runs and judges them."""

    def __init__(self, work: Path, with_run: bool) -> None:
        """Write the seeds.

        Args:
            work: folder for everything; it is emptied first, except for compiled programs.
            with_run: whether there is to be a seed that is a run's folder.
        """
        self._work = work.resolve()
        self.worker = Worker(self._work)
        self._seeds = self._work / "seeds"
        for name in ("seeds", "input", "kept"):
            shutil.rmtree(self._work / name, ignore_errors=True)
        self._work.mkdir(parents=True, exist_ok=True)

        def run(words: list[str]) -> int:
            done = self.worker.run(words, self._work, _COMPILING_S)
            return 1 if done.status is None else done.status

        write_seeds(self._seeds, run, with_run)

    def edits(self, kind: Kind, random: Random) -> list[Edit]:
        """Draw the damage of one input."""
        return kind.draw(self._seeds / kind.seed, random)

    def verdict(
        self, kind: Kind, words: tuple[str, ...], edits: list[Edit], keep: Path | None = None
    ) -> Verdict:
        """Return the verdict on a command for a damaged seed; ``keep``: where its input is left."""
        folder, results = self._work / "input" / "given", self._work / "input" / "out"
        shutil.rmtree(folder.parent, ignore_errors=True)
        shutil.copytree(self._seeds / kind.seed, folder)
        results.mkdir()
        # commands whose work would take minutes are given a file where they need a folder
        (results / "taken").touch()
        for edit in edits:
            try:
                edit.apply(folder)
            # an earlier edit may have left nothing that this one can read and change
            except Exception:
                continue
        filled = [word.replace("{in}", str(folder)).replace("{out}", str(results)) for word in words]
        done = self.worker.run(filled, results, COMPILING_SILENCE_S if kind.compiles else SILENCE_S)
        verdict = judge(done, folder, results, MOST_BYTES, kind.ends, kind.may_be_nan)
        if keep is not None:
            shutil.rmtree(keep, ignore_errors=True)
            keep.mkdir(parents=True)
            shutil.copytree(folder, keep / "given", symlinks=True)
            (keep / "command").write_text(" ".join(filled) + "\n")
            shutil.rmtree(results)
            results.mkdir()
            (keep / "err").write_text(self.worker.run([*filled, "--debug"], results).err)
        return verdict

    def smaller(self, kind: Kind, words: tuple[str, ...], edits: list[Edit], seen: Verdict) -> list[Edit]:
        """Return as few of the edits as show the same failure."""
        left = list(edits)
        for edit in edits:
            fewer = [one for one in left if one is not edit]
            if fewer and signature(self.verdict(kind, words, fewer)) == signature(seen):
                left = fewer
        return left

    def keep(self, failure: Failure, kind: Kind) -> None:
        """Leave the failing input, its command and its traceback in the campaign's folder."""
        number = len(list((self._work / "kept").glob("*"))) + 1
        folder = self._work / "kept" / f"{number:03d} {failure.verdict} {failure.kind}"
        self.verdict(kind, failure.words, failure.edits, folder)
        (folder / "failure.json").write_text(failure.to_json() + "\n")


def signature(verdict: Verdict) -> str:
    """Return the way of failing without what differs from input to input: paths, numbers, quoted words."""
    text = re.sub(r"/\S+|'[^']*'|\"[^\"]*\"|\([^)]*\)|b'.*", "", verdict.evidence)
    return f"{verdict.name}: {re.sub(r'[-+]?[0-9][0-9.e+]*', 'N', text)[:90]}"


def run_campaign(
    work: Path, inputs: int, seed: int = 0, kinds: tuple[str, ...] = (), show: bool = False
) -> Campaign:
    """Run ``inputs`` damaged files through the command line, in turn of every kind.

    Args:
        work: folder for seeds, inputs and kept failures.
        inputs: number of inputs in all.
        seed: of the damage; the same seed gives the same inputs.
        kinds: names of the kinds to run; empty: all.
        show: whether new failures are printed when they are found.
    """
    chosen = [kind for kind in KINDS if not kinds or kind.name in kinds]
    campaign = Campaign({kind.name: Counter() for kind in chosen})
    begin = time.monotonic()
    with _trial(work, any(kind.seed == "run" for kind in chosen)) as trial:
        for number, kind in enumerate(islice(_in_turn(chosen), inputs)):
            random = Random(f"{seed} {kind.name} {number}")
            edits = trial.edits(kind, random)
            words = kind.words(edits, random)
            verdict = trial.verdict(kind, words, edits)
            campaign.verdicts[kind.name].update(["inputs", verdict.name])
            if verdict.failed:
                _note(campaign, trial, kind, words, edits, verdict, show)
            if show and number % 500 == 499:
                print(f"{number + 1} inputs, {time.monotonic() - begin:.0f} s", flush=True)
    campaign.seconds = time.monotonic() - begin
    return campaign


def _in_turn(kinds: list[Kind]) -> Iterator[Kind]:
    for turn in count():
        yield from (kind for kind in kinds if turn % kind.every == 0)


def _note(
    campaign: Campaign,
    trial: Trial,
    kind: Kind,
    words: tuple[str, ...],
    edits: list[Edit],
    verdict: Verdict,
    show: bool,
) -> None:
    way = f"{kind.name} {signature(verdict)}"
    if way in campaign.failures:
        campaign.failures[way].count += 1
        return
    small = trial.smaller(kind, words, edits, verdict)
    failure = Failure(kind.name, words, small, verdict.name, verdict.evidence)
    campaign.failures[way] = failure
    trial.keep(failure, kind)
    if show:
        print(f"{verdict.name} ({kind.name}): {verdict.evidence}", flush=True)


@contextmanager
def _trial(work: Path, with_run: bool) -> Iterator[Trial]:
    trial = Trial(work, with_run)
    try:
        yield trial
    finally:
        trial.worker.close()
