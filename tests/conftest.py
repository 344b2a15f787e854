"""Numerics settings, one cache of compiled programs and run-time shape checks shared by all tests."""

import gc
import os
import shutil
import tempfile
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=true")

import jax
import pytest
from jaxtyping import install_import_hook

from lio_jax.core import xla
from tests import type_checker

jax.config.update("jax_enable_x64", True)

_OWN_CACHE = None if os.environ.get("LIO_JAX_TEST_CACHE") else tempfile.mkdtemp(prefix="lio-jax-programs-")
"""Made by this process and shared by the worker processes, which inherit its name."""
if _OWN_CACHE:
    os.environ["LIO_JAX_TEST_CACHE"] = _OWN_CACHE
os.environ["LIO_JAX_CACHE"] = os.environ["LIO_JAX_TEST_CACHE"]
_KEEP_PROGRAMS = {
    "jax_compilation_cache_dir": os.environ["LIO_JAX_TEST_CACHE"],
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
"""What the command line sets too: a test that runs it changes nothing for those after it."""
for _name, _value in _KEEP_PROGRAMS.items():
    jax.config.update(_name, _value)
    # processes that tests start read it there
    os.environ[_name.upper()] = str(_value)

# Before any import of these modules: the shapes and dtypes of every call are checked in the tests. Left out:
# lio_jax.core.types, because the runner fills a Scan with numpy arrays, and the host-side packages, because
# their protocols are not runtime_checkable.
_CHECKED = (
    "core.config core.error_state core.files core.geometry core.hashing core.implicit core.params "
    "core.prefix_sum core.settings "
    "imu lidar mapping registration estimation loops recipes sim"
)
install_import_hook([f"lio_jax.{name}" for name in _CHECKED.split()], f"{type_checker.__name__}.checked")


def pytest_unconfigure() -> None:
    """Remove the cache that this process made."""
    if _OWN_CACHE:
        shutil.rmtree(_OWN_CACHE, ignore_errors=True)


_MAPPINGS, _MEMORY = Path("/proc/self/maps"), Path("/proc/self/statm")
_MOST_MAPPINGS = 40_000
"""The kernel allows a process 65,530. Compiled programs take several each; where one finds none left, the
process ends by a segmentation fault."""
_MOST_MEMORY = 3 * 2**30
"""Bytes; several processes share a machine, and most of what they hold are programs not needed again."""


@pytest.fixture(scope="module", autouse=True)
def room_for_programs():
    """Give the room of the last modules' programs to the next one's where it runs short."""
    if not _MEMORY.exists():
        return
    mappings = _MAPPINGS.read_bytes().count(b"\n")
    resident = int(_MEMORY.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    if mappings > _MOST_MAPPINGS or resident > _MOST_MEMORY:
        xla.forget_programs()
        jax.clear_caches()
        gc.collect()
