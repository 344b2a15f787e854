"""A disk that fills up, without one."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from jax._src import compilation_cache


@contextmanager
def full_disk_after(size: int) -> Iterator[None]:
    """Let no file grow beyond ``size`` bytes: write() then fails in the middle, as on a full disk.

    JAX keeps no programs meanwhile: files cut off would spoil the cache that all tests share.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        with patch.object(compilation_cache, "put_executable_and_time"):
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
