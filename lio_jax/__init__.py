"""Differentiable LiDAR-inertial odometry as pure jitted JAX functions.

The names a notebook needs are listed in ``__init__.pyi`` and loaded on first use; importing them changes no
global setting of JAX. Turn on double precision first where you want the command line's results:
``jax.config.update("jax_enable_x64", True)``.
"""

from importlib.metadata import version
from typing import Any

import lazy_loader

_loaded, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Load a public name on first use; ``__version__`` is the installed distribution's."""
    return version("lio-jax") if name == "__version__" else _loaded(name)
