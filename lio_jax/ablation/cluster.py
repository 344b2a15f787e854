"""Worker processes of an ablation: on this machine or at a dask scheduler.

dask also loads this module into each worker process of this machine, and calls :func:`dask_setup` there.
"""

import asyncio
import importlib.util
import logging
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lio_jax.core.errors import LioJaxError, UsageError

if TYPE_CHECKING:
    from distributed import Client, Nanny, SpecCluster


def dask_setup(worker: Any) -> None:
    """Let the command alone handle Ctrl-C, which a terminal sends to all processes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


_WORKER_BYTES = 2 << 30
"""Memory for each worker, bytes."""
_ANSWER_S = 10
_ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
"""Parallel runs are fastest with one thread each, and no result depends on the number of cores."""


@dataclass(frozen=True)
class Workers:
    """A dask client, and the state of its workers."""

    client: "Client"
    count: Callable[[], int]
    """Function that returns the present number of workers."""
    deaths_allowed: int
    """Largest number of worker deaths during a run before the run counts as failed."""
    revive: Callable[[], None] = lambda: None
    """Function that replaces workers that have ended for good."""


@contextmanager
def on_this_machine(most: int) -> Iterator[Workers]:
    """Start workers for the block: one per GPU, else one per core, as far as the memory suffices.

    All of them listen on the loopback interface only.

    Args:
        most: largest number of workers that have work to do.
    """
    import dask
    from distributed import Client, Scheduler, SpecCluster

    gpus = visible_gpus()
    count = max(1, min(most, len(gpus) or _cores_with_memory()))
    environments = [_environment(gpus[number] if gpus else None) for number in range(count)]
    settings = {
        # deaths of workers are counted here for each run; dask would count them for a group of runs
        "distributed.scheduler.allowed-failures": 0,
        "distributed.logging.distributed": "critical",
    }
    options = {"dashboard_address": "127.0.0.1:0", "host": "127.0.0.1", "port": 0}
    with (
        dask.config.set(settings),
        SpecCluster({}, {"cls": Scheduler, "options": options}, silence_logs=logging.CRITICAL) as cluster,
        Crew(cluster, environments) as crew,
        Client(cluster) as client,
    ):
        yield Workers(client, lambda: count, deaths_allowed=3, revive=crew.revive)


class Crew:
    """Worker processes of this machine; a dask nanny restarts each worker, and this class the nannies.

    A nanny restarts a worker that died, but gives up on a worker that dies again while it starts.
    """

    def __init__(self, cluster: "SpecCluster", environments: Sequence[dict[str, str]]) -> None:
        self._cluster = cluster
        self._environments = environments
        self._nannies: dict[int, Nanny] = {}
        self._failed_starts = 0

    def __enter__(self) -> "Crew":
        self.revive()
        return self

    def __exit__(self, *_: object) -> None:
        self._cluster.sync(self._close)

    def revive(self) -> None:
        """Start the workers that are missing.

        Raises:
            LioJaxError: the workers failed to start repeatedly.
        """
        self._cluster.sync(self._start)

    async def _start(self) -> None:
        from distributed import Nanny, Status

        gone = {
            number
            for number in range(len(self._environments))
            if number not in self._nannies
            or self._nannies[number].status in (Status.closed, Status.closing, Status.failed)
        }
        nannies = {
            number: Nanny(
                self._cluster.scheduler_address,
                nthreads=1,
                memory_limit=0,
                dashboard=False,
                host="127.0.0.1",
                silence_logs=logging.CRITICAL,
                preload=["lio_jax.ablation.cluster"],
                env=self._environments[number],
            )
            for number in gone
        }
        ended = await asyncio.gather(*(_started(nanny) for nanny in nannies.values()))
        problems = [error for error in ended if error is not None]
        self._nannies |= nannies
        self._failed_starts = self._failed_starts + 1 if problems else 0
        if self._failed_starts > _MOST_FAILED_STARTS:
            raise LioJaxError(f"workers cannot be started on this machine ({problems[0]}).")

    async def _close(self) -> None:
        await asyncio.gather(*(nanny.close(timeout=1) for nanny in self._nannies.values()))


async def _started(nanny: "Nanny") -> Exception | None:
    try:
        await nanny
    except Exception as error:
        return error
    return None


_MOST_FAILED_STARTS = 20


@contextmanager
def at_scheduler(address: str) -> Iterator[Workers]:
    """Use the workers of a running dask scheduler, which must see the same files and the same package.

    Raises:
        UsageError: no scheduler answers at the address, or it has no workers.
    """
    from distributed import Client

    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_ANSWER_S)
    except (OSError, ValueError, TimeoutError):
        raise UsageError(
            f"--scheduler {address}: no dask scheduler answers there; start one with 'dask scheduler' and on "
            "each machine 'dask worker ADDRESS --nthreads 1', or leave --scheduler out to use this machine."
        ) from None
    finally:
        logger.setLevel(level)
    with client:
        try:
            client.wait_for_workers(1, timeout=_ANSWER_S)
        except TimeoutError:
            raise UsageError(
                f"--scheduler {address}: the scheduler has no workers; start some with "
                f"'dask worker {address} --nthreads 1'."
            ) from None
        yield Workers(client, lambda: _workers_of(client), deaths_allowed=0)


def _workers_of(client: "Client") -> int:
    return len(client.scheduler_info(n_workers=-1)["workers"])


def visible_gpus() -> list[str]:
    """Return the GPUs that JAX would use, as $CUDA_VISIBLE_DEVICES names them, without opening any."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    plugins = ("jax_cuda12_plugin", "jax_cuda13_plugin")
    if not any(map(importlib.util.find_spec, plugins)) or (platforms and "cuda" not in platforms):
        return []
    if (named := os.environ.get("CUDA_VISIBLE_DEVICES")) is not None:
        return [word for word in named.split(",") if word.strip()]
    try:
        listed = subprocess.run(
            ["nvidia-smi", "--query-gpu=index", "--format=csv,noheader"],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return []
    return listed.stdout.split()


def _environment(gpu: str | None) -> dict[str, str]:
    if gpu is not None:
        return {"CUDA_VISIBLE_DEVICES": gpu}
    return {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {_ONE_THREAD}".strip()}


def _cores_with_memory() -> int:
    import psutil  # distributed needs it too

    return min(len(os.sched_getaffinity(0)), int(psutil.virtual_memory().available) // _WORKER_BYTES)
