"""What an objective is: sums that grow from scan to scan, and a value of them."""

from dataclasses import replace
from typing import Any, Protocol

import equinox as eqx
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.params import Params
from lio_jax.core.types import NavState, Scan
from lio_jax.recipes.output import Evidence


class TruePose(eqx.Module):
    """Where the vehicle was at a scan's end."""

    T_world_imu: jaxlie.SE3
    known: Bool[Array, ""]
    """False where there is no truth."""


class Observed(eqx.Module):
    """One scan, the parameters, and what its step leaves to see."""

    nav: NavState
    """At the scan's end."""
    rmse: Float[Array, ""]
    """Robustly weighted root mean square distance of the scan to the map, m."""
    status: Int32[Array, ""]
    """Of the solve, see :mod:`lio_jax.estimation.iterated_filter`."""
    lost: Bool[Array, ""]
    covariance: Float[Array, "24 24"] | None
    """Of the navigation state; None from recipes that carry none."""
    evidence: Evidence | None
    """How well the scan was foretold; None from recipes that carry no covariance."""
    log_evidence: Float[Array, ""] | None
    """Of all measurements so far; None from recipes without a smoother."""
    scan: Scan | None = None
    """As it was fed to the step."""
    params: Params | None = None
    """The step's."""

    @staticmethod
    def of(state: Any, output: Any) -> "Observed":
        """Return what a recipe's step leaves to see."""
        result = output.registration
        return Observed(
            nav=state.nav,
            rmse=result.rmse,
            status=result.status,
            lost=output.lost,
            covariance=output.covariance,
            evidence=output.evidence,
            log_evidence=output.log_evidence,
        )

    def beside(self, scan: Scan, params: Params) -> "Observed":
        """Return the same with what went into the step.

        Not by :meth:`of`: a program that hands its arguments through has them copied.
        """
        return replace(self, scan=scan, params=params)


class Objective(Protocol):
    """A loss over a recording: lower is better. Its sums are a pytree of floating-point arrays."""

    def start(self) -> Any:
        """Return the sums before the first scan."""
        ...

    def add(self, sums: Any, seen: Observed, truth: TruePose) -> Any:
        """Return the sums with one more scan."""
        ...

    def value(self, sums: Any) -> Float[Array, ""]:
        """Return the loss."""
        ...
