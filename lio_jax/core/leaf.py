"""One declaration for each setting: default, unit, bounds and how it is tuned stand at the field itself.

A section is a class of settings that belong together: an :class:`equinox.Module` of traced parameters,
declared by :func:`leaf`, or a frozen dataclass of static settings, declared by :func:`static`. A tree is a
class whose fields are sections, declared by :func:`section`. The docstring of a setting is the string below
its field.
"""

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, TypeVar, get_args, get_origin

import equinox as eqx
import jax.numpy as jnp

from lio_jax.core.types import state_dtype

Tuned = Literal["log", "linear", "turn"]
LARGEST = 1e9
"""No setting is larger than this in size: the powers of far larger numbers overflow."""
_DECLARED = "lio_jax"
T = TypeVar("T")


@dataclass(frozen=True)
class Declared:
    """What the code says about one setting."""

    default: Any
    """A number, a tuple of numbers, text or a truth value."""
    unit: str = ""
    """SI unit; empty where the number has none."""
    above: float | None = None
    """The value has to be larger than this."""
    least: float | None = None
    """The value must not be smaller than this."""
    most: float | None = None
    """The value must not be larger than this."""
    why: str = ""
    """Why the bound holds, for the message."""
    tuned: Tuned | None = None
    """How the value is tuned by gradient: its logarithm, itself, or as a rotation; None: it has no
    derivative, because it chooses points, voxels, when to stop or what to report."""
    power_of_two: bool = False
    """The value is a power of two."""
    per_ring: bool = False
    """The value has one number per ring of the sensor, or none at all."""
    moves_points: bool = False
    """The value says where the points of a scan lie, so that a derivative by it has to go through the map."""

    def problem(self, value: Any) -> str:
        """Return why a value is impossible ("must be ..."), or nothing if it is possible.

        Args:
            value: of the default's type.
        """
        if self.tuned == "turn":
            norm = sum(x * x for x in value) ** 0.5
            if abs(norm - 1) >= 1e-3:
                return f"must be a unit quaternion x y z w (its norm is {norm:.4g})"
        if self.power_of_two and (value < 2 or value & (value - 1)):
            return "must be a power of two"
        numbers = value if self.per_ring else [value]
        numbers = [one for one in numbers if isinstance(one, int | float) and not isinstance(one, bool)]
        for number in numbers:
            if self.most is not None and number > self.most:
                return f"must be at most {self.most:g}{self.why}"
            if self.least is not None and number < self.least:
                return (
                    "must not be negative"
                    if self.least == 0
                    else f"must be at least {self.least:g}{self.why}"
                )
            if self.above is not None and number <= self.above:
                return "must be greater than zero" if self.above == 0 else f"must be above {self.above:g}"
        several = value if isinstance(value, list | tuple) else [value]
        if any(isinstance(one, int | float) and abs(one) > LARGEST for one in several):
            return f"must not exceed {LARGEST:g} in size"
        return ""


def leaf(
    default: float | Sequence[float],
    unit: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
    tuned: Tuned | None = None,
    per_ring: bool = False,
    moves_points: bool = False,
) -> Any:
    """Declare a traced parameter.

    Args:
        default: a number, or several for a vector.
        unit: SI unit; empty where the number has none.
        above: exclusive lower bound.
        least: inclusive lower bound.
        most: inclusive upper bound.
        tuned: how the parameter is tuned by gradient; None: it has no derivative.
        per_ring: it has one number per ring of the sensor, or none at all.
        moves_points: it says where the points of a scan lie.
    """
    value = default if isinstance(default, int | float) else tuple(default)
    declared = Declared(
        value, unit, above, least, most, "", tuned, per_ring=per_ring, moves_points=moves_points
    )
    return eqx.field(default=value, metadata={_DECLARED: declared})


def static(
    default: Any,
    unit: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    why: str = "",
    power_of_two: bool = False,
) -> Any:
    """Declare a static setting, which shapes arrays or chooses code.

    Args:
        default: a number, text, a truth value, or a tuple of sizes in ascending order.
        unit: SI unit; empty where the number has none.
        above: exclusive lower bound.
        least: inclusive lower bound.
        why: reason for the lower bound, for the message.
        power_of_two: the value is one.
    """
    declared = Declared(default, unit, above, least, None, why and f": {why}", None, power_of_two)
    return dataclasses.field(default=default, metadata={_DECLARED: declared})


@dataclass(frozen=True)
class _Section:
    """Makes a section of a tree with its defaults."""

    kind: type
    own: dict[str, Any]
    """Defaults in which the tree differs from the section's declarations."""

    def default(self, name: str) -> Any:
        """Return the default of a setting as plain value."""
        return self.own.get(name, self.declared(name).default)

    def declared(self, name: str) -> Declared:
        """Return the declaration of a setting."""
        return {field.name: field.metadata[_DECLARED] for field in self.fields()}[name]

    def fields(self) -> tuple[dataclasses.Field[Any], ...]:
        """Return the section's fields."""
        return dataclasses.fields(self.kind)

    def __call__(self) -> Any:
        if not issubclass(self.kind, eqx.Module):
            return self.kind(**self.own)
        return _arrays(self.kind, {field.name: self.default(field.name) for field in self.fields()})


def section(kind: type, **own: Any) -> Any:
    """Declare a section of a tree, with the defaults in which this tree differs from the section's own."""
    unknown = set(own) - {field.name for field in dataclasses.fields(kind)}
    if unknown:
        raise TypeError(f"{kind.__name__} declares no {', '.join(sorted(unknown))}")
    return dataclasses.field(default_factory=_Section(kind, own))


def _arrays(kind: type, values: Mapping[str, Any]) -> Any:
    """Return a section of traced parameters, from plain numbers."""
    return kind(**{name: jnp.asarray(value, state_dtype()) for name, value in values.items()})


@dataclass(frozen=True)
class Setting:
    """One setting of a tree."""

    path: str
    """Section and name, such as ``map.voxel_size``."""
    declared: Declared
    """With the tree's own default."""
    type: Any
    """The field's annotation."""
    doc: str
    """The docstring of the field."""


def sections_of(tree: Any) -> dict[str, type]:
    """Return the classes of a tree's sections by name."""
    return {name: made.kind for name, made in _sections(tree).items()}


def _sections(tree: Any) -> dict[str, _Section]:
    sections = {}
    for place in dataclasses.fields(tree):
        if not isinstance(place.default_factory, _Section):
            raise TypeError(f"{tree.__name__}.{place.name}: declare it by section(...)")
        sections[place.name] = place.default_factory
    return sections


@cache
def settings_of(tree: Any) -> dict[str, Setting]:
    """Return the settings of a tree by path, in the order of their declaration.

    Args:
        tree: a class whose fields are sections.
    """
    found: dict[str, Setting] = {}
    for name, made in _sections(tree).items():
        docs = _field_docs(made.kind)
        for field in made.fields():
            own = dataclasses.replace(made.declared(field.name), default=made.default(field.name))
            path = f"{name}.{field.name}"
            found[path] = Setting(path, own, field.type, docs.get(field.name, ""))
    return found


def numbers_of(tree: Any) -> dict[str, dict[str, Any]]:
    """Return a tree's defaults as plain numbers and lists, by section and name."""
    numbers: dict[str, dict[str, Any]] = {}
    for path, setting in settings_of(tree).items():
        place, name = path.split(".")
        value = setting.declared.default
        numbers.setdefault(place, {})[name] = list(value) if isinstance(value, tuple) else value
    return numbers


def traced(tree: type[T], values: Mapping[str, Mapping[str, Any]] | None = None) -> T:
    """Return a tree of traced parameters as arrays in the state's precision.

    Args:
        tree: a class whose fields are sections of :func:`leaf`.
        values: plain numbers by section and name, for at least the tree's sections. None: the defaults.
    """
    numbers = numbers_of(tree) if values is None else values
    return tree(
        **{
            name: _arrays(kind, {field.name: numbers[name][field.name] for field in dataclasses.fields(kind)})
            for name, kind in sections_of(tree).items()
        }
    )


def choices(kind: Any) -> tuple[Any, ...]:
    """Return the values that an annotation allows where it lists them; else nothing."""
    return get_args(kind) if get_origin(kind) is Literal else ()


@cache
def _field_docs(kind: type) -> dict[str, str]:
    """Return the docstrings below the fields of a class and its bases."""
    docs: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        # a class without fields may have no source, such as those of collections.abc
        if not inspect.get_annotations(one) or one.__module__.startswith("equinox"):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(one))).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, below in zip(body.body, body.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
            ):
                docs[field.target.id] = " ".join(str(below.value.value).split())
    return docs
