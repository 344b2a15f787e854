"""The back end on a thread of its own, beside the odometry, which never waits for it."""

import queue
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.settings import Settings
from lio_jax.loops.back_end import BackEnd, Correction
from lio_jax.loops.keyframe import Keyframe
from lio_jax.run.track import Tracked


class BesideOdometry:
    """Takes every scan's result, keeps those that are keyframes, and has them corrected in order."""

    def __init__(self, back_end: BackEnd) -> None:
        self._back_end = back_end
        self._waiting: queue.Queue[Keyframe | None] = queue.Queue()
        self._thread = threading.Thread(target=self._work, name="back end", daemon=True)
        self._stopped = threading.Event()
        self.error: Exception | None = None
        self.busy_s = 0.0
        """Time spent on keyframes."""
        self._thread.start()

    def add(self, keyframe: Keyframe) -> None:
        """Hand over the next keyframe and return at once."""
        self._waiting.put(keyframe)

    def finish(self, now: bool = False) -> Correction:
        """Return the correction of all keyframes; with ``now`` of those that are done with."""
        if now:
            self._stopped.set()
        self._waiting.put(None)
        self._thread.join()
        return self._back_end.correction()

    def _work(self) -> None:
        while (keyframe := self._waiting.get()) is not None and not self._stopped.is_set():
            began = time.perf_counter()
            try:
                self._back_end.add(keyframe)
            except Exception as error:
                self.error = error
                return
            self.busy_s += time.perf_counter() - began
