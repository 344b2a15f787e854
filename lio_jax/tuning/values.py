"""An objective at several vectors of parameters at once."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.types import Scan
from lio_jax.core.xla import PerShape
from lio_jax.recipes import recipe_named
from lio_jax.recipes.params import RecipeConfig as Config
from lio_jax.run.track import run_steps
from lio_jax.tuning.objectives import Objective, Observed, TruePose
from lio_jax.tuning.parameters import ParameterVector
from lio_jax.tuning.recording import Recording


class StreamingValues:
    """An objective at several vectors of parameters at once: one program, batched over them."""

    def __init__(self, recipe: str, config: Config, free: ParameterVector, objective: Objective) -> None:
        """Keep what shapes the programs."""
        module = recipe_named(recipe)(config)
        self._objective = objective

        def one(x: Any, state: Any, scan: Any, imu: Any) -> tuple[Any, Observed]:
            state, output = module.step(free(x), state, scan, imu)
            return state, Observed.of(state, output)

        def add(x: Any, sums: Any, seen: Observed, scan: Scan, truth: TruePose) -> Any:
            return objective.add(sums, seen.beside(scan, free(x)), truth)

        self.init = PerShape(jax.jit(jax.vmap(lambda x, imu: module.init(free(x), imu), (0, None))))
        self.step = PerShape(jax.jit(jax.vmap(one, (0, 0, None, None)), donate_argnums=1))
        self._add = PerShape(jax.jit(jax.vmap(add, (0, 0, 0, None, None))))
        self._value = PerShape(jax.jit(jax.vmap(objective.value)))

    def __call__(self, xs: NDArray[np.float64], recording: Recording) -> NDArray[np.float64]:
        """Return the objective at each row of ``xs``."""
        x = jnp.asarray(xs)
        sums = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (len(x), *leaf.shape)), self._objective.start()
        )
        for fed, _, seen in run_steps(_Batch(self, x), recording.scan_inputs()):
            sums = self._add(x, sums, seen, fed.scan, recording.truth_at(fed.end_ns))
        return np.asarray(self._value(sums))


class _Batch:
    """A :class:`lio_jax.run.track.Step` over a batch of states."""

    def __init__(self, programs: StreamingValues, x: Any) -> None:
        self.initial_state = partial(programs.init, x)
        self._step = partial(programs.step, x)

    def restarted(self, state: Any, imu: Any) -> Any:
        return self.initial_state(imu).with_velocity_of(state)

    def __call__(self, state: Any, scan: Any, imu: Any) -> tuple[Any, Any]:
        return self._step(state, scan, imu)
