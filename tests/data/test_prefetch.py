import threading
import time
from collections.abc import Iterator

import pytest

from lio_jax.data.sequence import prefetched


def prefetch_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "prefetch"]


class Source:
    """Count up and remember how far, on which thread, and whether it was closed."""

    def __init__(self, count: int, fail_at: int | None = None) -> None:
        self.made, self.closed, self.thread = 0, False, ""
        self._count, self._fail_at = count, fail_at

    def items(self) -> Iterator[int]:
        try:
            for number in range(self._count):
                if number == self._fail_at:
                    raise OSError("disk gone")
                self.thread = threading.current_thread().name
                self.made += 1
                yield number
        finally:
            self.closed = True


@pytest.mark.parametrize("depth", [0, 1, 3, 100])
def test_items_come_in_order_and_all(depth: int) -> None:
    assert list(prefetched(Source(50).items(), depth)) == list(range(50))
    assert not prefetch_threads()


def test_items_are_made_ahead_on_a_thread_but_not_further_than_asked() -> None:
    source = Source(100)
    stream = prefetched(source.items(), 3)
    assert next(stream) == 0
    deadline = time.monotonic() + 2.0
    while source.made < 5 and time.monotonic() < deadline:
        time.sleep(0.005)
    time.sleep(0.05)
    assert source.made == 5  # the one handed out, three ready, one waiting for room
    assert source.thread == "prefetch"
    stream.close()


def test_depth_zero_uses_no_thread() -> None:
    source = Source(3)
    list(prefetched(source.items(), 0))
    assert source.thread == threading.current_thread().name


def test_an_exception_arrives_in_its_place() -> None:
    stream = prefetched(Source(10, fail_at=4).items(), 2)
    assert [next(stream) for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(OSError, match="disk gone"):
        next(stream)
    assert not prefetch_threads()


def test_closing_early_closes_the_source_and_ends_the_thread() -> None:
    source = Source(10**9)
    stream = prefetched(source.items(), 2)
    assert [next(stream), next(stream)] == [0, 1]
    stream.close()
    assert source.closed
    assert not prefetch_threads()


def test_an_interrupt_in_the_consumer_ends_the_thread() -> None:
    def consume() -> None:
        for item in prefetched(Source(10**9).items(), 2):
            if item == 3:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        consume()
    assert not prefetch_threads()


def test_an_unstarted_stream_starts_no_thread() -> None:
    stream = prefetched(Source(5).items(), 2)
    assert not prefetch_threads()
    del stream
