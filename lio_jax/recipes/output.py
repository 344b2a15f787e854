"""The output of every recipe's step, in addition to its state."""

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.estimation.innovation import Innovation
from lio_jax.registration.gauss_newton import Registration
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
    """Covariance of the navigation state's error in the world; None from recipes without a covariance."""
    evidence: Evidence | None = None
    """Statistics of the match; None from recipes without a covariance."""
    log_evidence: Float[Array, ""] | None = None
    """Log marginal likelihood of all measurements since the smoother's start; None without a smoother."""
    restarted: Bool[Array, ""] | None = None
    """True if the smoother diverged and was started again; None from recipes without a smoother."""
    smoother_unfinished: Bool[Array, ""] | None = None
    """The match converged, and the smoother reached its largest number of linearisations; None from recipes
    without one."""
