"""The parameters that are tuned, as one vector: positive ones by their logarithm."""

from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.core.leaf import Declared, Tuned, settings_of
from lio_jax.recipes.transforms import Dual


class ParameterVector(eqx.Module):
    """Parameters as a function of a vector x of P numbers.

    A positive leaf is exp(x); lengths, angles and times that may be negative are x; a rotation is its start
    times Exp(x), rad.
    """

    start: eqx.Module
    """A tree of parameters, a recipe's or the back end's: those where ``x`` is :meth:`first`. Leaves that are
    not tuned keep these values."""
    paths: tuple[str, ...] = eqx.field(static=True)
    """Leaves that are tuned, such as ``imu.gyro_noise``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the P components' names.

        Such as ``imu.gyro_noise``, ``extrinsics.translation.x`` or ``lidar.ring_range_offset.17``.
        """
        return tuple(name for path in self.paths for name in _component_names(self.start, path))

    @property
    def declared(self) -> tuple[Declared, ...]:
        """Return the declaration of each of the P components."""
        leaves = settings_of(type(self.start))
        return tuple(leaves[path].declared for path in self.paths for _ in _component_names(self.start, path))

    def first(self) -> Float[Array, " p"]:
        """Return the vector of the start."""
        return jnp.concatenate([_encoded(self.start, path) for path in self.paths])

    def __call__(self, x: Float[Array, " p"]) -> Any:
        """Return the parameters of a vector."""
        params, used = self.start, 0
        for path in self.paths:
            size = len(_component_names(self.start, path))
            value = _decoded(self.start, path, x[used : used + size])
            params = eqx.tree_at(partial(_leaf, path=path), params, value)
            used += size
        return params

    def split(self, params: Any) -> tuple[Any, Any]:
        """Return the leaves that are tuned, and the others, each with None in place of the rest."""
        none = jax.tree.map(lambda _: False, self.start)
        tuned = eqx.tree_at(
            lambda tree: [_leaf(tree, path) for path in self.paths], none, [True] * len(self.paths)
        )
        return eqx.partition(params, tuned)

    def with_tangents(self, x: Float[Array, " p"]) -> Dual:
        """Return the parameters of a vector and their derivatives by it."""
        directions = jnp.eye(len(x), dtype=x.dtype)
        dot = jax.vmap(lambda direction: jax.jvp(lambda x: self.split(self(x))[0], (x,), (direction,))[1])
        return Dual(self(x), dot(directions))

    def overrides(self, x: NDArray[np.float64]) -> dict[str, Any]:
        """Return the tuned leaves as plain numbers by their settings path, ``params.imu.gyro_noise``."""
        params = self(jnp.asarray(x))
        return {f"params.{path}": np.asarray(_leaf(params, path)).tolist() for path in self.paths}


def free_parameters(
    start: eqx.Module, patterns: tuple[str, ...] | list[str], rings: Callable[[], int] | None = None
) -> ParameterVector:
    """Return the parameters that the patterns name.

    A leaf with a number per ring that has none starts at zero for each ring, where a pattern names such
    leaves alone.

    Args:
        start: values to start from, a recipe's or :class:`lio_jax.settings.shared.GlobalParams`.
        patterns: paths with or without the leading ``params.``, or globs such as ``imu.*_noise``: of those,
            the leaves that have a derivative.
        rings: returns the number of the recording's rings; None: it is not known.

    Raises:
        UsageError: a pattern names no leaf, or only leaves without a derivative, a leaf to be tuned on a
            log scale starts at zero, or the rings of a leaf are not known.
    """
    leaves = settings_of(type(start))
    smooth_ones = [path for path, leaf in leaves.items() if leaf.declared.tuned]
    chosen: list[str] = []
    for pattern in patterns:
        named = named_leaves(pattern, leaves)
        if not named:
            raise UsageError(f"no parameter is called '{pattern}'; {_choice(smooth_ones)}")
        smooth = [leaf for leaf in named if leaf in smooth_ones]
        if not smooth:
            raise UsageError(
                f"'{pattern}' has no derivative, because it only chooses (points, voxels, when to stop); "
                f"{_choice(smooth_ones)}"
            )
        if rings is not None and all(_has_no_rings(start, leaf) for leaf in smooth):
            start = _with_zeros(start, smooth, rings())
        starting = [leaf for leaf in smooth if _may_start(start, leaf)]
        if not starting and _has_no_rings(start, smooth[0]):
            raise UsageError(
                f"'{smooth[0]}' has no number for any ring; give a start for each ring with "
                f"--set params.{smooth[0]}=[0, 0, ...]."
            )
        if not starting:
            raise UsageError(
                f"'{smooth[0]}' is 0 and would be tuned on a log scale; give it a positive start with "
                f"--set params.{smooth[0]}=VALUE."
            )
        chosen += [leaf for leaf in starting if leaf not in chosen]
    if not chosen:
        raise UsageError(f"no parameter to tune was named; {_choice(smooth_ones)}")
    return ParameterVector(start, tuple(chosen))


def named_leaves(pattern: str, paths: Iterable[str]) -> list[str]:
    """Return the paths that a path or a glob names, with or without the leading ``params.``."""
    bare = pattern.removeprefix("params.")
    return [path for path in paths if fnmatchcase(path, bare)]


def _choice(paths: list[str]) -> str:
    return "those that can be tuned: " + ", ".join(paths) + "."


def _may_start(start: eqx.Module, path: str) -> bool:
    value = _leaf(start, path)
    return value.size > 0 and (_tuned(start, path) != "log" or bool(jnp.all(value > 0)))


def _has_no_rings(start: eqx.Module, path: str) -> bool:
    return settings_of(type(start))[path].declared.per_ring and not _leaf(start, path).size


def _with_zeros(start: eqx.Module, paths: list[str], count: int) -> Any:
    def leaves(params: Any) -> list[Array]:
        return [_leaf(params, path) for path in paths]

    return eqx.tree_at(leaves, start, [jnp.zeros(count, value.dtype) for value in leaves(start)])


def _tuned(start: eqx.Module, path: str) -> Tuned | None:
    return settings_of(type(start))[path].declared.tuned


def _leaf(params: Any, path: str) -> Array:
    section, name = path.split(".")
    return getattr(getattr(params, section), name)


def _component_names(start: eqx.Module, path: str) -> tuple[str, ...]:
    if settings_of(type(start))[path].declared.per_ring:
        return tuple(f"{path}.{ring}" for ring in range(len(_leaf(start, path))))
    value = _leaf(start, path)
    if _tuned(start, path) == "turn" or value.shape == (3,):
        return tuple(f"{path}.{axis}" for axis in "xyz")
    if value.ndim:
        return tuple(f"{path}.{number}" for number in range(value.size))
    return (path,)


def _encoded(start: eqx.Module, path: str) -> Float[Array, " k"]:
    value, tuned = _leaf(start, path), _tuned(start, path)
    if tuned == "turn":
        return jnp.zeros(3, value.dtype)
    return jnp.ravel(jnp.log(value) if tuned == "log" else value)


def _decoded(start: eqx.Module, path: str, x: Float[Array, " k"]) -> Array:
    value, tuned = _leaf(start, path), _tuned(start, path)
    if tuned == "turn":
        turned = jaxlie.SO3.from_quaternion_xyzw(value) @ jaxlie.SO3.exp(x)
        return turned.normalize().as_quaternion_xyzw()
    return jnp.exp(x.reshape(value.shape)) if tuned == "log" else x.reshape(value.shape)
