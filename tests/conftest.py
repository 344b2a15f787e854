"""Numerics settings, one cache of compiled programs and run-time shape checks shared by all tests."""

import gc
import os
import shutil
import time
from importlib.metadata import version
from pathlib import Path

# The older emitters compile a quarter faster; lio_jax.core.xla compiles the runner's programs by them too.
# Later versions have no such flag, and an unknown flag ends the process.
if version("jaxlib").startswith("0.10."):
    os.environ.setdefault(
        "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=true --xla_cpu_use_fusion_emitters=false"
    )

import jax
import pytest
from jaxtyping import install_import_hook

from lio_jax.core import xla
from tests import type_checker

jax.config.update("jax_enable_x64", True)

_ROOT = Path(__file__).parents[1]
_KEPT = Path(os.environ.setdefault("LIO_JAX_TEST_CACHE", str(_ROOT / ".pytest_cache" / "programs")))
"""Compiled programs, shared by the worker processes and kept for the next run: a program that has not changed
is not compiled again."""
_MOST_KEPT = 2 * 2**30
"""Bytes. One run leaves about 0.2 GiB."""
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


def pytest_configure(config: pytest.Config) -> None:
    """Drop the kept programs once they take too much room."""
    if not hasattr(config, "workerinput") and _KEPT.is_dir():
        taken = sum(entry.stat().st_size for entry in os.scandir(_KEPT))
        if taken > _MOST_KEPT:
            shutil.rmtree(_KEPT, ignore_errors=True)


_MAPPINGS, _MEMORY = Path("/proc/self/maps"), Path("/proc/self/statm")
_MOST_MAPPINGS = 35_000
"""The kernel allows a process 65,530. Compiled programs take several each; where one finds none left, the
process ends by a segmentation fault. One test adds up to 16,000."""
_MOST_MEMORY = 3 * 2**30
"""Bytes; several processes share a machine, and most of what they hold are programs not needed again."""


@pytest.fixture(scope="module", autouse=True)
def memory_for_programs():
    """Give the memory of the last modules' programs to the next one's where it runs short."""
    if _MEMORY.exists():
        resident = int(_MEMORY.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        if resident > _MOST_MEMORY:
            _forget_programs()


_SECONDS_BETWEEN_COUNTS = 5.0
"""Counting the mappings takes some 20 ms: short tests share one count."""
_counted_at = [0.0]


@pytest.fixture(autouse=True)
def mappings_for_programs():
    """Give the mappings of the last tests' programs to the next one's where they run short."""
    if _MAPPINGS.exists() and time.monotonic() - _counted_at[0] > _SECONDS_BETWEEN_COUNTS:
        if _MAPPINGS.read_bytes().count(b"\n") > _MOST_MAPPINGS:
            _forget_programs()
        _counted_at[0] = time.monotonic()


def _forget_programs() -> None:
    xla.forget_programs()
    jax.clear_caches()
    gc.collect()
