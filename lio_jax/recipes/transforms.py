"""Functions of a recipe: batches, tangents, and the opening of a drive that is in motion from the start."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.types import ImuBatch, Scan
from lio_jax.recipes.recipe import State


@runtime_checkable
class RecipeLike(Protocol):
    """The two pure functions of a recipe, or of a transformed one.

    States have a method ``with_velocity_of(found)`` as those of a recipe do. Equal objects are the same
    functions: compiled programs are kept by them.
    """

    def init(self, params: Any, imu: ImuBatch | None = None) -> Any:
        """Return the state before the first scan."""
        ...

    def step(self, params: Any, state: Any, scan: Scan, imu: ImuBatch | None = None) -> tuple[Any, Any]:
        """Return state and output after a scan."""
        ...


@dataclass(frozen=True)
class Batched:
    """A recipe over several parameter sets at once; every leaf of params, state and output has them first."""

    recipe: RecipeLike

    def init(self, params: Any, imu: ImuBatch | None = None) -> Any:
        """Return the states before the first scan."""
        return jax.vmap(self.recipe.init, (0, None))(params, imu)

    def step(self, params: Any, state: Any, scan: Scan, imu: ImuBatch | None = None) -> tuple[Any, Any]:
        """Return states and outputs after a scan, which all members share."""
        return jax.vmap(self.recipe.step, (0, 0, None, None))(params, state, scan, imu)


def batched(recipe: RecipeLike) -> Batched:
    """Return the recipe under ``jax.vmap`` over its parameters."""
    return Batched(recipe)


class Dual(NamedTuple):
    """A pytree and P derivatives of some of its leaves."""

    value: Any
    dot: Any
    """Derivatives in the same structure, P along the first axis of each leaf; None for a leaf that is a
    constant."""

    def with_velocity_of(self, found: "Dual") -> "Dual":
        """Return this first state with the velocity that a later state found, and its derivatives."""
        return Dual(self.value.with_velocity_of(found.value), self.dot.with_velocity_of(found.dot))


@dataclass(frozen=True)
class WithTangents:
    """A recipe whose params, state and output are :class:`Dual`, by forward-mode differentiation."""

    recipe: RecipeLike
    through_map: bool

    def init(self, params: Dual, imu: ImuBatch | None = None) -> Dual:
        """Return the state before the first scan and its derivatives."""
        return push_forward(
            lambda params: self.recipe.init(params, imu), params, through_map=self.through_map
        )

    def step(self, params: Dual, state: Dual, scan: Scan, imu: ImuBatch | None = None) -> tuple[Dual, Dual]:
        """Return state and output after a scan, and their derivatives."""

        def one_step(params: Any, state: Any) -> tuple[Any, Any]:
            return self.recipe.step(params, state, scan, imu)

        both = push_forward(one_step, params, state, through_map=self.through_map)
        new, output = map(Dual, both.value, both.dot)
        return new, output


def with_tangents(recipe: RecipeLike, through_map: bool = False) -> WithTangents:
    """Return the recipe with derivatives by the parameters.

    Solves are differentiated implicitly (:mod:`lio_jax.core.implicit`): a tangent costs no iterations.

    Args:
        recipe: hashable.
        through_map: what the map knows of its points moves with the poses at which they were inserted, in
            recipes whose states say so (:meth:`lio_jax.recipes.recipe.State.varying_map`); False: the map is
            a constant of the derivative.
    """
    return WithTangents(recipe, through_map)


def push_forward(function: Callable[..., Any], *arguments: Dual, through_map: bool = False) -> Dual:
    """Return a function's value and its derivatives.

    Args:
        function: pure.
        arguments: P derivatives each.
        through_map: see :func:`with_tangents`.
    """
    halves = [_split(argument) for argument in arguments]

    def of_smooth(*smooth: Any) -> tuple[Any, Any]:
        whole = (eqx.combine(part, rest) for part, (_, rest) in zip(smooth, halves, strict=True))
        return split_smooth(function(*whole), through_map)

    def along(*tangents: Any) -> tuple[Any, Any, Any]:
        primals = tuple(smooth for smooth, _ in halves)
        value, dot, rest = jax.jvp(of_smooth, primals, tangents, has_aux=True)
        return value, rest, dot

    dots = [argument.dot for argument in arguments]
    value, rest, dot = jax.vmap(along, out_axes=(None, None, 0))(*dots)
    return Dual(eqx.combine(value, rest), dot)


def split_smooth(tree: Any, through_map: bool) -> tuple[Any, Any]:
    """Return what has a derivative in a tree, and the rest, such as counts and choices.

    Each is the tree with None in place of the other's leaves.

    Args:
        tree: anything, with states of recipes in it.
        through_map: whether what a state's map knows of its points is part of the first.
    """
    smooth = jax.tree.map(lambda node: _smooth(node, through_map), tree, is_leaf=_is_state)
    return eqx.partition(tree, smooth)


def _split(dual: Dual) -> tuple[Any, Any]:
    varies = jax.tree.map(lambda dot: dot is not None, dual.dot, is_leaf=lambda dot: dot is None)
    return eqx.partition(dual.value, varies)


def _smooth(node: Any, through_map: bool) -> Any:
    if not _is_state(node):
        return eqx.is_inexact_array(node)
    varying = node.varying_map() if through_map else False
    return eqx.tree_at(lambda state: state.map, jax.tree.map(eqx.is_inexact_array, node), varying)


def _is_state(node: Any) -> bool:
    return isinstance(node, State)


@runtime_checkable
class Stepper(Protocol):
    """What takes an estimate from scan to scan; its state is a recipe's, or a transformed recipe's."""

    def init(self, imu: ImuBatch | None, velocity: NDArray[np.float64] | None = None) -> Any:
        """Return the state before the first scan.

        Args:
            imu: samples up to its end, or None.
            velocity: (3,) replaces ``params.initial.velocity``, m/s; None: it holds.
        """
        ...

    def step(self, state: Any, scan: Scan, imu: ImuBatch | None) -> tuple[Any, Any]:
        """Return state and output after a scan; ``state`` is consumed."""
        ...


@runtime_checkable
class StepInput(Protocol):
    """One scan as a stepper takes it."""

    @property
    def scan(self) -> Scan:
        """Return the padded sweep."""
        ...

    @property
    def imu(self) -> ImuBatch | None:
        """Return the samples that cover it."""
        ...

    @property
    def before(self) -> ImuBatch | None:
        """Return the samples up to its end, for a start here."""
        ...

    @property
    def first_velocity(self) -> NDArray[np.float64] | None:
        """Return the velocity at the first scan's end that this second scan shows, m/s, IMU axes; or None."""
        ...


def reopened(
    stepper: Stepper, state: Any, output: Any, first: StepInput, second: StepInput
) -> tuple[Any, Any]:
    """Return state and output after the first scan, compensated with the velocity that the second one shows.

    Only the second scan shows how fast a vehicle is moving from the start; until then the map holds the first
    scan distorted.

    Args:
        stepper: of the run.
        state: after the first scan; it is consumed.
        output: of the first scan.
        first: the first usable scan.
        second: the next one.
    """
    velocity = second.first_velocity
    if velocity is not None:
        state, output = stepper.step(stepper.init(first.before, velocity), first.scan, first.imu)
    if first.scan.duration == 0 or first.scan.points.shape != second.scan.points.shape:
        return state, output
    found, _ = stepper.step(state, second.scan, second.imu)
    opened = stepper.init(first.before, velocity).with_velocity_of(found)
    return stepper.step(opened, first.scan, first.imu)


def with_first_velocity(params: Any, velocity: Float[Array | np.ndarray, "3"] | None) -> Any:
    """Return params, or those of a transformed recipe, that start with a velocity that two scans show.

    Args:
        params: a recipe's, those of a batch, or a :class:`Dual`.
        velocity: m/s along the IMU's axes; None: the params stay.
    """
    if velocity is None:
        return params
    if isinstance(params, Dual):
        return push_forward(lambda value: with_first_velocity(value, velocity), params)
    leaf = params.initial.velocity
    shown = jnp.broadcast_to(jnp.asarray(velocity, leaf.dtype), leaf.shape)
    params = eqx.tree_at(lambda one: one.initial.velocity, params, shown)
    if not hasattr(params.initial, "velocity_sigma"):
        return params
    sigma = jnp.minimum(params.initial.velocity_sigma, _SHOWN_SIGMA)
    return eqx.tree_at(lambda one: one.initial.velocity_sigma, params, sigma)


_SHOWN_SIGMA = 0.3
"""Standard deviation of a velocity that the plan views of two scans show, m/s."""
