"""Compile each program once for a package's tests, and leave JAX as it was."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax

_NAMES = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@contextmanager
def kept_programs(folder: Path) -> Iterator[Path]:
    """Let ``lio-jax`` keep its programs in $LIO_JAX_CACHE, or in ``folder`` where that is not set."""
    from jax.experimental.compilation_cache import compilation_cache

    before = {name: getattr(jax.config, name) for name in _NAMES}
    given = os.environ.get("LIO_JAX_CACHE")
    os.environ["LIO_JAX_CACHE"] = given or str(folder)
    compilation_cache.reset_cache()
    try:
        yield Path(os.environ["LIO_JAX_CACHE"])
    finally:
        if given is None:
            del os.environ["LIO_JAX_CACHE"]
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()
