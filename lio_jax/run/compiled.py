"""The compiled functions of a recipe, kept for the life of the process."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.core.types import ImuBatch, Scan
from lio_jax.core.xla import programs
from lio_jax.recipes.params import RecipeParams as Params
from lio_jax.recipes.recipe import CorrectingRecipe, PagingRecipe
from lio_jax.recipes.transforms import RecipeLike, with_first_velocity
from lio_jax.run.feedback import Feedback
from lio_jax.run.paging import KeyframePager, Pager
from lio_jax.settings.settings import Settings, recipe_of


class Compiled:
    """The compiled functions of a recipe, or of a transformed one, at given parameters.

    The programs are kept for the life of the process (:func:`lio_jax.core.xla.programs`): another one of an
    equal recipe compiles nothing, whatever its parameters.
    """

    def __init__(self, recipe: RecipeLike, params: Any) -> None:
        """Look for the programs; those that are missing are compiled on first use.

        Args:
            recipe: hashable.
            params: what its functions take first.
        """
        self.params = params
        self.init_programs = programs(type(recipe).init, recipe)
        self.step_programs = programs(type(recipe).step, recipe, donate=(1,))
        self._compiled_before_s = self._compiled_s()

    @property
    def compile_s(self) -> float:
        """Return the time spent on compiling since this was made, s."""
        return self._compiled_s() - self._compiled_before_s

    def init(self, imu: ImuBatch | None, velocity: NDArray[np.float64] | None = None) -> Any:
        """Return the state before the first scan.

        Args:
            imu: samples up to its end, or None.
            velocity: (3,) replaces ``params.initial.velocity``, m/s; None: it holds.
        """
        return self.init_programs(with_first_velocity(self.params, velocity), imu)

    def step(self, state: Any, scan: Scan, imu: ImuBatch | None) -> tuple[Any, Any]:
        """Return state and output after a scan; ``state`` is consumed."""
        return self.step_programs(self.params, state, scan, imu)

    def structures(self, before: ImuBatch | None, scan: Scan, imu: ImuBatch | None) -> tuple[Any, Any]:
        """Return state and output after a first scan, the shape and dtype in the place of each array.

        Args:
            before: inertial samples up to the scan's end, or None.
            scan: padded.
            imu: samples that cover it, or None.
        """
        state = self.init_programs.result(self.params, before)
        return self.step_programs.result(self.params, state, scan, imu)

    def _compiled_s(self) -> float:
        return self.init_programs.compile_s + self.step_programs.compile_s


class CompiledStep(Compiled):
    """The compiled functions of the recipe that settings name, at their parameters."""

    params: Params

    def __init__(self, settings: Settings) -> None:
        """Look for the programs; those that are missing are compiled on first use."""
        self.recipe = recipe_of(settings)
        super().__init__(self.recipe, settings.params())

    def feedback(self) -> Feedback:
        """Return a new feedback of the back end.

        Raises:
            UsageError: the recipe has none.
        """
        if not isinstance(self.recipe, CorrectingRecipe):
            raise UsageError(
                "config.backend.feedback=true moves keyframes, and this recipe matches scans with none; "
                "leave it out, or take the recipe lio_sam."
            )
        return Feedback(self.recipe, self.params)

    def pager(self) -> Pager | None:
        """Return what hands parts of the map over during a new run; None where nothing does."""
        return KeyframePager(self.recipe, self.params) if isinstance(self.recipe, PagingRecipe) else None
