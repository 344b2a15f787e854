"""Count what JAX compiles."""

from collections.abc import Iterator
from contextlib import contextmanager

from jax import monitoring

_COMPILED = "/jax/core/compile/backend_compile_duration"


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Yield a list that gets the function of every compilation; a program from a cache on disk counts."""
    functions: list[str] = []

    def note(event: str, duration: float, **told: object) -> None:
        if event == _COMPILED:
            functions.append(str(told.get("fun_name")))

    monitoring.register_event_duration_secs_listener(note)
    try:
        yield functions
    finally:
        monitoring.unregister_event_duration_listener(note)
