"""The back end on a thread of its own: the odometry never waits for it."""

import queue
import threading
import time

from lio_jax.loops.back_end import BackEnd, Correction
from lio_jax.loops.keyframe import Keyframe


class BackEndThread:
    """Hands keyframes to a back end, which takes them in order, one at a time."""

    def __init__(self, back_end: BackEnd) -> None:
        """Begin to wait for keyframes.

        Args:
            back_end: belongs to the thread until :meth:`finish`.
        """
        self._back_end = back_end
        self._waiting: queue.SimpleQueue[Keyframe | None] = queue.SimpleQueue()
        self._stopped = threading.Event()
        self.error: Exception | None = None
        """What ended the work early."""
        self.busy_s = 0.0
        """Time spent on keyframes."""
        # a daemon: whatever ends the program must not wait for the queue to be worked off
        self._thread = threading.Thread(target=self._work, name="back end", daemon=True)
        self._thread.start()

    def add(self, keyframe: Keyframe) -> None:
        """Hand over the next keyframe and return at once."""
        self._waiting.put(keyframe)

    def finish(self, hurry: bool = False) -> Correction:
        """Return the correction of all keyframes; in a hurry, of those it has dealt with.

        Where the work ended with an error, the correction is that of the keyframes before.
        """
        if hurry:
            self._stopped.set()
        self._waiting.put(None)
        self._thread.join()
        return self._back_end.correction()

    def stop(self) -> None:
        """Let the thread end after the keyframe it is at, without waiting for it."""
        self._stopped.set()
        self._waiting.put(None)

    def _work(self) -> None:
        try:
            while (keyframe := self._waiting.get()) is not None and not self._stopped.is_set():
                began = time.perf_counter()
                self._back_end.add(keyframe)
                self.busy_s += time.perf_counter() - began
            self._back_end.settle()
        except Exception as error:
            self.error = error
