"""Loaded by dask into each worker process of this machine."""

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the command."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
