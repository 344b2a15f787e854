"""The compiler's options hold where the compiler knows them, and do not matter where it does not."""

import gc
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core import xla as compilation


@pytest.mark.parametrize("options", [compilation._CPU_OPTIONS, {"xla_cpu_an_option_of_another_day": True}])
def test_a_program_is_compiled_whether_or_not_the_options_are_known(options, monkeypatch):
    monkeypatch.setattr(compilation, "_CPU_OPTIONS", options)
    program = compilation.compiled(jax.jit(lambda x: jnp.sum(jnp.sin(x) ** 2)), jnp.arange(3.0))
    assert program(jnp.arange(3.0)) == pytest.approx(np.sum(np.sin(np.arange(3)) ** 2))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="options of the CPU backend")
def test_a_kernel_is_not_divided_among_threads():
    table, rows = jnp.zeros((65536, 81)), jnp.arange(512)
    divided = 'outer_dimension_partitions":["'
    gathered = jax.jit(lambda table, rows: table[rows])
    if len(os.sched_getaffinity(0)) > 1:  # else XLA divides nothing
        assert divided in gathered.lower(table, rows).compile().as_text()
    assert divided not in compilation.compiled(gathered, table, rows).as_text()


def test_an_impossible_value_is_no_unknown_option(monkeypatch):
    monkeypatch.setattr(compilation, "_CPU_OPTIONS", {"xla_cpu_use_fusion_emitters": "perhaps"})
    with pytest.raises(jax.errors.JaxRuntimeError):
        compilation.compiled(jax.jit(lambda x: x + 1), 1.0)


def test_the_collector_works_on_whatever_happens():
    def impossible(x):
        assert not gc.isenabled()
        raise ValueError("not to be traced")

    with pytest.raises(ValueError, match="not to be traced"):
        compilation.compiled(jax.jit(impossible), 1.0)
    assert gc.isenabled()
