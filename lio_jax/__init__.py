"""Differentiable LiDAR-inertial odometry as pure jitted JAX functions.

The names a notebook needs are listed in ``__init__.pyi`` and loaded on first use; importing them changes no
global setting of JAX. Turn on double precision first where you want the command line's results:
``jax.config.update("jax_enable_x64", True)``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
