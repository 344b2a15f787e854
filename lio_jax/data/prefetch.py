"""Run an iterator ahead on a thread, so that decoding and estimation overlap."""

import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class _End:
    error: BaseException | None


def prefetched(iterator: Iterator[T], depth: int) -> Iterator[T]:
    """Yield the items of ``iterator``; up to ``depth`` of them are produced ahead on a thread.

    An exception of the iterator is raised here, at its place. If the consumer stops early (the generator is
    closed or collected), the iterator is closed and the thread has ended on return.

    Args:
        iterator: the iterator, which is consumed on one thread only.
        depth: number of items held ready; 0 or less: no thread.
    """
    if depth <= 0:
        yield from iterator
        return
    ready: queue.Queue[T | _End] = queue.Queue(depth)
    stopped = threading.Event()
    # daemon: a consumer that neither finishes nor closes must not keep the interpreter from exiting
    worker = threading.Thread(target=_produce, args=(iterator, ready, stopped), name="prefetch", daemon=True)
    worker.start()
    try:
        while not isinstance(item := ready.get(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        stopped.set()
        while worker.is_alive():
            _discard(ready)
            worker.join(0.01)


def _produce(iterator: Iterator[T], ready: "queue.Queue[T | _End]", stopped: threading.Event) -> None:
    error: BaseException | None = None
    try:
        for item in iterator:
            if stopped.is_set():
                break
            ready.put(item)
        if stopped.is_set() and hasattr(iterator, "close"):
            iterator.close()
    except BaseException as raised:  # every exception belongs to the consumer
        error = raised
    ready.put(_End(error))


def _discard(ready: "queue.Queue[T | _End]") -> None:
    """Make room, so that a producer that waits in put() notices the stop."""
    try:
        while True:
            ready.get_nowait()
    except queue.Empty:
        pass
