"""What a run ran on, for whoever compares its times or repeats it."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax

_LIBRARIES = ("lio-jax", "jax", "jaxlib", "numpy", "scipy")


def environment() -> dict[str, str]:
    """Return versions, processor and devices by name."""
    devices = sorted({f"{device.platform}: {device.device_kind}" for device in jax.devices()})
    return {
        **{name: _version(name) for name in _LIBRARIES},
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": processor(),
        "cores": str(usable_cores()),
        "devices": ", ".join(devices),
        "double precision": "on" if jax.config.read("jax_enable_x64") else "off",
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def usable_cores() -> int:
    """Return how many cores the process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"
