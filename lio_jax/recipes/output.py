"""What every recipe's step reports beside its state."""

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.estimation.innovation import Innovation
from lio_jax.registration.gauss_newton import Registration
from lio_jax.registration.point_evidence import PointEvidence


class Evidence(eqx.Module):
    """How well a scan was foretold by the prediction and the map."""

    innovation: Innovation
    """Of the scan match as one measurement of the pose."""
    information: Float[Array, "6 6"]
    """Of that measurement: the share of the points' information that the filter believed."""
    gradient: Float[Array, "6"]
    """Of the measurement's half squared error at the solution."""
    pose_covariance: Float[Array, "6 6"]
    """Of the predicted lidar pose, in the same perturbation."""
    points: PointEvidence | None = None
    """None from recipes whose map keeps no distributions."""


class Output(eqx.Module):
    """Of one scan."""

    registration: Registration
    lost: Bool[Array, ""]
    """The scan could not be matched; the pose is the prediction and the map was left alone."""
    nis: Float[Array, ""]
    """Normalised innovation squared of the match against the prediction; 0 where there was none."""
    nis_dof: Int32[Array, ""]
    """Its degrees of freedom: the directions the match observed."""
    points: Float[Array, "m 3"]
    """The thinned scan, motion compensated, in world axes from ``origin``, m."""
    points_mask: Bool[Array, " m"]
    added: Bool[Array, " m"]
    """Which of ``points`` were new to the map."""
    origin: Float[Array, "3"]
    """Where ``points`` count from, m in world."""
    thinned_away: Int32[Array, ""]
    """Occupied cells of the scan beyond its capacities: they thin the scan further, evenly."""
    map_dropped: Int32[Array, ""]
    """Points whose voxel found no room in the map."""
    corners: Bool[Array, " m"] | None = None
    """Which of ``points`` are corners, the others being surfaces; None from recipes without features."""
    covariance: Float[Array, "24 24"] | None = None
    """Of the navigation state's error in the world; None from recipes that carry none."""
    evidence: Evidence | None = None
    """None from recipes that carry no covariance."""
    log_evidence: Float[Array, ""] | None = None
    """Log marginal likelihood of all measurements since the smoother began; None from recipes without one."""
    restarted: Bool[Array, ""] | None = None
    """The smoother ran away and began anew; None from recipes without one."""
    smoother_unfinished: Bool[Array, ""] | None = None
    """The match converged, and the smoother reached its largest number of linearisations; None from recipes
    without one."""
