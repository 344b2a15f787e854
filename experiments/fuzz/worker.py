"""A process that runs commands of ``lio-jax`` one after another, and reports what each one did.

It keeps the package imported, so that a command takes milliseconds. It says in a line that it is ready.
Then a job is a line of JSON on standard input and its report one on standard output; the own output of the
command goes to the files of the job.
"""

import json
import os
import resource
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from typing import Any

from lio_jax.cli import main

_LARGEST_FILE = 2 << 30
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_FOLDER_OF = {"os.remove": 1, "os.rmdir": 1, "os.mkdir": 2, "os.rename": 2, "os.link": 2, "os.symlink": 2}
"""Events that change a path, and which of their arguments is the open folder to which it is relative."""


class Watch:
    """Notes the paths that a command writes, renames or removes outside the folders it may write to."""

    def __init__(self) -> None:
        self.allowed: tuple[str, ...] = ("/",)
        self.outside: list[str] = []

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Take an audit event of the interpreter."""
        if event == "open":
            path, _, flags = arguments
            if isinstance(path, int) or not isinstance(flags, int) or not flags & _WRITES:
                return
            folder = -1
        elif event in _FOLDER_OF:
            path, folder = arguments[0], arguments[_FOLDER_OF[event]]
        else:
            return
        base = os.getcwd() if folder == -1 else f"/proc/self/fd/{folder}"
        real = os.path.realpath(os.path.join(base, os.fsdecode(path)))
        if not real.startswith(self.allowed):
            self.outside.append(f"{event} {real}")


def resident_bytes(process: int | str = "self", peak: bool = False) -> int:
    """Return the memory that a process holds, bytes; or the most that it held since it was last reset."""
    name = "VmHWM" if peak else "VmRSS"
    status = Path(f"/proc/{process}/status").read_text()
    return next((int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith(name)), 0)


def computing_s(process: int) -> float:
    """Return the time that a process has computed on all cores together, s; 0 for one that has ended."""
    try:
        # the name of the program, in parentheses, may hold spaces
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run_job(job: dict[str, Any], watch: Watch) -> dict[str, Any]:
    """Run one command with its output in files, and return the report."""
    caches = (os.environ["LIO_JAX_CACHE"], tempfile.gettempdir(), "/dev/null")
    before = resident_bytes()
    Path("/proc/self/clear_refs").write_text("5")
    kept = [os.dup(number) for number in (1, 2)]
    for number, name in ((1, "out"), (2, "err")):
        opened = os.open(job[name], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(opened, number)
        os.close(opened)
    watch.allowed = (os.path.realpath(job["allowed"]), *map(os.path.realpath, caches))
    watch.outside = []
    try:
        status = main(job["words"])
    except BaseException:  # whatever leaves the command line would end the user's process
        traceback.print_exc()
        status = -1
    finally:
        watch.allowed = ("/",)
        sys.stdout.flush()
        sys.stderr.flush()
        for number, old in zip((1, 2), kept, strict=True):
            os.dup2(old, number)
            os.close(old)
    grown = resident_bytes(peak=True) - before
    return {"status": status, "grown": grown, "outside": watch.outside}


def serve() -> None:
    """Run the jobs that come on standard input until it is closed."""
    # a user sees each kind of warning once, in a process of its own
    warnings.simplefilter("always", RuntimeWarning)
    resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, _LARGEST_FILE))
    watch = Watch()
    sys.addaudithook(watch)
    with os.fdopen(os.dup(1), "w") as reports:
        reports.write("ready\n")
        reports.flush()
        for line in sys.stdin:
            reports.write(json.dumps(run_job(json.loads(line), watch)) + "\n")
            reports.flush()


if __name__ == "__main__":
    serve()
