"""Process-wide settings of the command line; the import of the package itself changes none."""

import os
import sys
from pathlib import Path


def prepare_jax() -> None:
    """Turn on double precision and the persistent compilation cache.

    The cache is in $LIO_JAX_CACHE, else in $XDG_CACHE_HOME/lio_jax, else in ~/.cache/lio_jax. If it cannot be
    written, programs are compiled again each time.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    cache = Path(os.environ.get("LIO_JAX_CACHE") or Path(base) / "lio_jax")
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        say(f"note: {cache} cannot be written; compiled programs are not kept (set LIO_JAX_CACHE).")
        return
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def say(line: str) -> None:
    """Print a line to standard error, apart from the results on standard output."""
    print(line, file=sys.stderr, flush=True)
