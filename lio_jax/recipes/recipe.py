"""What a recipe is: a static config, traced parameters, and two pure functions from scan to scan."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.error_state import DOF, POSITION, ROTATION
from lio_jax.core.types import ImuBatch, NavState, Scan
from lio_jax.estimation.innovation import Innovation
from lio_jax.mapping.keyframes import Page
from lio_jax.recipes.params import RecipeConfig, RecipeParams
from lio_jax.registration.gauss_newton import Registration
from lio_jax.registration.params import RegistrationParams
from lio_jax.registration.point_evidence import PointEvidence


class Evidence(eqx.Module):
    """Statistics of how well the prediction and the map agree with a scan."""

    innovation: Innovation
    """Innovation of the scan match, taken as one measurement of the pose."""
    information: Float[Array, "6 6"]
    """Information of that measurement: the share of the points' information that the filter used."""
    gradient: Float[Array, "6"]
    """Gradient of half of the measurement's squared error at the solution."""
    pose_covariance: Float[Array, "6 6"]
    """Covariance of the predicted lidar pose, for the same perturbation."""
    points: PointEvidence | None = None
    """Statistics of the points' distances; None from recipes whose map has no distributions."""


class KeyframeTable(eqx.Module):
    """Which keyframes a recipe holds after a scan, and whether the scan is one."""

    numbers: Int32[Array, " k"]
    """Running numbers of the keyframes that have a row; -1 in a free row."""
    added: Int32[Array, ""]
    """Running number of the scan as a keyframe; -1 where it is none."""
    sparse: Bool[Array, ""]
    """The keyframe stays in the map for good."""
    time: Float[Array, ""]
    """The scan's time on the keyframes' clock, s."""


class Output(eqx.Module):
    """The output of a step for one scan."""

    registration: Registration
    """Result of the scan match."""
    lost: Bool[Array, ""]
    """True if the scan could not be matched; the pose is then the prediction, and the map did not change."""
    nis: Float[Array, ""]
    """Normalised innovation squared of the match; 0 without a match."""
    nis_dof: Int32[Array, ""]
    """Degrees of freedom of ``nis``: the number of directions that the match observed."""
    points: Float[Array, "m 3"]
    """The thinned scan, motion compensated, in world axes from ``origin``, m."""
    points_mask: Bool[Array, " m"]
    """True where a row of ``points`` is real."""
    added: Bool[Array, " m"]
    """True for ``points`` that were new to the map."""
    origin: Float[Array, "3"]
    """Origin of ``points``, m, in world."""
    thinned_away: Int32[Array, ""]
    """Number of occupied cells of the scan beyond the capacities; their loss thins the scan evenly."""
    map_dropped: Int32[Array, ""]
    """Number of points whose voxel found no room in the map."""
    corners: Bool[Array, " m"] | None = None
    """True for ``points`` that are corners, False for surface points; None from recipes without features."""
    covariance: Float[Array, "24 24"] | None = None
    """Covariance of the navigation state's error in the world. Without inertial samples it holds pose and
    velocity, and zeros otherwise. None from recipes without a covariance."""
    evidence: Evidence | None = None
    """Statistics of the match as an update of the prediction; None from recipes without a filter."""
    shown_by_noise: Float[Array, "6 3"] | None = None
    """Directions of motion of which noise alone may have given all information that the match has, as
    :func:`lio_jax.registration.point_evidence.shown_by_noise` returns them; None from recipes that do not
    look for them."""
    log_evidence: Float[Array, ""] | None = None
    """Log marginal likelihood of all measurements since the smoother's start; None without a smoother."""
    too_few_features: Bool[Array, ""] | None = None
    """True if the scan has fewer corners or surface points than a match needs; None from recipes without such
    a bound."""
    new_piece: Bool[Array, ""] | None = None
    """True if a new piece of map begins with the scan, at the predicted pose."""
    restarted: Bool[Array, ""] | None = None
    """True if the smoother diverged and was started again; None from recipes without a smoother."""
    keyframes: KeyframeTable | None = None
    """The keyframes of the submap; None from recipes without keyframes."""
    matched: Bool[Array, " m"] | None = None
    """True for ``points`` whose distance from the map counted in the match; None unless
    ``config.registration.mark_matched`` is true."""
    smoother_unfinished: Bool[Array, ""] | None = None
    """The match converged, and the smoother reached its largest number of linearisations; None from recipes
    without one."""


class State(eqx.Module):
    """What a recipe carries from scan to scan: a pytree with a navigation state and a map."""

    nav: eqx.AbstractVar[NavState]
    """State at the last scan's end."""
    map: eqx.AbstractVar[Any]
    """The map that scans are matched with: a pytree."""

    def varying_map(self) -> Any:
        """Return which leaves of the map have a derivative: a prefix of its tree.

        None of them, unless a recipe says so: the map is then a constant of all derivatives.
        """
        return False

    @abstractmethod
    def with_velocity_of(self, found: Any) -> Any:
        """Return this first state with the velocity that a later state found; every other leaf stays.

        A vehicle that is already moving distorts its first scan, which nothing can compensate before the
        second scan shows the velocity.
        """


M = TypeVar("M", bound=RegistrationParams)
C = TypeVar("C", bound=RecipeConfig)
P = TypeVar("P", bound=RecipeParams)
S = TypeVar("S", bound=State)

_CONVINCING = 0.25
"""Share of a scan's points that have to meet the map after an outage."""
_ENOUGH = 4.0
"""A scan begins a new piece of map if it has this many times ``params.registration.min_matches`` points."""


@runtime_checkable
class PagingRecipe(Protocol):
    """A recipe that takes back keyframes for which it had no more room."""

    def with_page(self, params: Any, state: Any, page: Page) -> Any:
        """Return a state with a keyframe that comes back; ``state`` is consumed."""
        ...


@runtime_checkable
class LocalisingRecipe(Protocol):
    """A recipe that can begin in a map of an earlier run."""

    def placed(self, params: Any, state: Any, T_world_imu: jaxlie.SE3) -> Any:
        """Return a state before the first scan at a pose in the map's world; ``state`` is consumed."""
        ...

    def with_map_points(
        self,
        params: Any,
        state: Any,
        points: Float[Array, "n 3"],
        mask: Bool[Array, " n"],
        origin: Float[Array, "3"],
    ) -> Any:
        """Return a state with points of a known map; ``state`` is consumed.

        Args:
            params: traced.
            state: of the recipe.
            points: m, in world axes from ``origin``.
            mask: which rows are real.
            origin: position near the vehicle, m in world.
        """
        ...


@runtime_checkable
class CorrectingRecipe(Protocol):
    """A recipe whose state can follow a correction of its keyframes."""

    def corrected(self, params: Any, state: Any, T_new_old: jaxlie.SE3, keyframes: jaxlie.SE3) -> Any:
        """Return a state whose world and keyframes have moved; ``state`` is consumed.

        Args:
            params: traced.
            state: after a scan.
            T_new_old: moves the vehicle, m; its rotation is about the vertical.
            keyframes: new T_world_lidar of the rows of :class:`KeyframeTable`, m.
        """
        ...


_PLACED_ROTATION, _PLACED_POSITION = 0.01, 0.1
"""Standard deviations per axis of the pose at which a run begins in a known map, rad and m."""


def placed_covariance(covariance: Float[Array, "24 24"]) -> Float[Array, "24 24"]:
    """Return the covariance of a first state in a known map, where its pose is not certain.

    Args:
        covariance: of the error state at the start of a map of its own (:mod:`lio_jax.core.error_state`).
    """
    sigma = jnp.zeros(DOF, covariance.dtype).at[ROTATION].set(_PLACED_ROTATION)
    return covariance + jnp.diag(sigma.at[POSITION].set(_PLACED_POSITION) ** 2)


class Outage(eqx.Module):
    """The time since the last scan that was matched, and what it requires of the next match.

    Where no scan was matched for longer than ``params.limits.outage``, the prediction may be wrong by more
    than a scan match can mend, or the vehicle has left the map. A scan that meets little of the map is then
    not matched by accident: it begins a new piece of map at the predicted pose, and odometry goes on from
    there.
    """

    elapsed: Float[Array, ""]
    """Time since the last scan that was matched, s."""
    is_long: Bool[Array, ""]
    """Longer than ``params.limits.outage``."""
    usable: Int32[Array, ""]
    """Number of points of the scan that could be matched."""

    @staticmethod
    def at(params: RecipeParams, elapsed: Float[Array, ""], mask: Bool[Array, " n"]) -> "Outage":
        """Return the outage before a scan.

        Args:
            params: ``params.limits.outage``.
            elapsed: time since the last scan that was matched, s.
            mask: True for the points of the scan that could be matched.
        """
        return Outage(elapsed, elapsed > params.limits.outage, jnp.sum(mask, dtype=jnp.int32))

    def required(self, registration: M) -> M:
        """Return the parameters with the number of matches that is required here."""
        share = jnp.where(self.is_long, _CONVINCING * self.usable, 0.0)
        needed = jnp.maximum(registration.min_matches, share.astype(registration.min_matches.dtype))
        return dataclasses.replace(registration, min_matches=needed)

    def begins_piece(self, lost: Bool[Array, ""], registration: RegistrationParams) -> Bool[Array, ""]:
        """Return whether a new piece of map begins with the scan.

        Args:
            lost: the scan could not be matched.
            registration: the recipe's own.
        """
        return lost & self.is_long & (self.usable >= _ENOUGH * registration.min_matches)

    @staticmethod
    def turning(params: RecipeParams, unmatched: Float[Array, ""], scan: Scan) -> Float[Array, ""]:
        """Return the share of the turning rate that lasts over a scan's interval without samples, 0 to 1.

        A vehicle keeps its velocity longer than its turning rate. A rate that is carried on through a long
        outage tilts the world.

        Args:
            params: ``params.limits.outage``, the time for which the turn goes on, s.
            unmatched: time from the last scan that was matched to the last scan's end, s.
            scan: its interval.
        """
        left = jnp.maximum(params.limits.outage - unmatched, 0.0)
        interval = scan.interval.astype(left.dtype)
        return jnp.minimum(left / jnp.where(interval > 0, interval, 1.0), 1.0)

    def after(self, unmatched: Bool[Array, ""]) -> Float[Array, ""]:
        """Return the time since the last match after this scan, s; ``unmatched``: it was not matched."""
        return jnp.where(unmatched, self.elapsed, 0.0)


@dataclass(frozen=True)
class Needs:
    """What a recipe needs from a recording."""

    imu: Literal["required", "used", "unused"] = "used"
    """required: the recipe refuses to run without inertial samples; used: it runs without, less well."""
    rings: bool = False
    """True if the recipe finds features along the sensor's rings."""
    point_times: bool = True
    """True if the recipe compensates the motion within a sweep whose points have times."""


@dataclass(frozen=True)
class Recipe(ABC, Generic[C, P, S]):
    """An odometry system as pure functions.

    Two recipes of one class with equal configs are equal and have the same hash: compiled programs are kept
    by them.
    """

    config: C
    """Static settings: what shapes arrays or chooses code."""

    config_type: ClassVar[type]
    """Class of ``config``: a tree of sections, see :mod:`lio_jax.core.leaf`."""
    params_type: ClassVar[type]
    """Class of the traced parameters that ``init`` and ``step`` take."""
    needs: ClassVar[Needs] = Needs()
    near_values: ClassVar[Mapping[str, float]] = {}
    """Values by path that replace the defaults where a recording's surroundings are near, m; none: the recipe
    has one set of values for all surroundings."""
    inertial_noise_from_recording: ClassVar[bool] = False
    """The white noise of the inertial sensor is found in the recording where it is not given."""
    range_noise_from_recording: ClassVar[bool] = False
    """The noise of the ranges is found in the recording where it is not given."""
    longest_bridged_gap: ClassVar[float] = 0.0
    """Longest gap between inertial samples, s, that the line between its ends bridges. In a longer one the
    recipe is without samples. A recipe that carries rate and velocity on by itself does better without."""
    given_values: ClassVar[Mapping[str, Any]] = {}
    """Values by path in which the recipe differs from the defaults of the back end and of the runner."""

    @property
    def compensates(self) -> bool:
        """Return whether the motion within a sweep is compensated."""
        return self.needs.point_times

    @abstractmethod
    def init(self, params: P, imu: ImuBatch | None = None) -> S:
        """Return the state before the first scan: at the world's origin, with an empty map.

        Args:
            params: traced.
            imu: samples of about a second up to the first scan's end; None: there are no inertial samples.
        """

    @abstractmethod
    def step(self, params: P, state: S, scan: Scan, imu: ImuBatch | None = None) -> tuple[S, Output]:
        """Estimate one scan's pose and add the scan to the map.

        Args:
            params: traced.
            state: after the scan before; it may be donated.
            scan: padded sweep; ``scan.interval`` is the time since the last scan's end.
            imu: samples around that time; None: there are no inertial samples.
        """
