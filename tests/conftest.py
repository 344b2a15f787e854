"""Numerics settings shared by all tests."""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=true")

import jax

jax.config.update("jax_enable_x64", True)
