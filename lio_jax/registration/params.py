"""Parameters of scan matching; a recipe's section inherits those that its parts read."""

from dataclasses import dataclass

import equinox as eqx

from lio_jax.core.leaf import leaf, static
from lio_jax.core.types import Scalar


class RegistrationParams(eqx.Module):
    """What every iterated scan match reads."""

    reassociation_distance: Scalar = leaf(0.015, "m", least=0)
    """Points are matched anew once the scan has moved farther than this from where it was last matched."""
    rotation_tolerance: Scalar = leaf(1e-4, "rad", above=0)
    """The solve has converged when a step turns less than this and moves less than
    ``translation_tolerance``."""
    translation_tolerance: Scalar = leaf(1e-3, "m", above=0)
    """The solve has converged when a step moves less than this and turns less than ``rotation_tolerance``."""
    min_matches: Scalar = leaf(50.0, above=0)
    """A scan with fewer matched points than this counts as lost."""


class ThinnedMatch(eqx.Module):
    """A scan that is thinned before it is matched."""

    point_spacing: Scalar = leaf(0.4, "m", above=0)
    """The scan is thinned to one point per cube of this edge length before it is matched."""


class RobustMatch(RegistrationParams):
    """A match with a robust kernel."""

    kernel: Scalar = leaf(0.15, "m", above=0, tuned="log")
    """Scale of the robust kernel: Geman-McClure's in default, Huber's in loam."""


class WeighedMatch(eqx.Module):
    """A match whose information enters a filter or a smoother."""

    information_scale: Scalar = leaf(1.0, above=0, most=1, tuned="log")
    """Share of the matches' information that the estimator believes. It is below 1 where neighbouring points
    share errors of the map that the estimator has no model of."""


class GaussNewtonMatch(RegistrationParams):
    """A match that is solved by Gauss-Newton alone."""

    degeneracy_ratio: Scalar = leaf(0.01, least=0, most=1)
    """A direction with less than this fraction of the strongest direction's information is degenerate."""


class FilterMatch(RegistrationParams, WeighedMatch):
    """A match that updates a filter."""

    inertial_degeneracy_ratio: Scalar = leaf(0.003, least=0, most=1)
    """Degeneracy ratio in a filter. It is lower than without a prediction, because the filter weighs weak
    information, such as a few trees on a plain, against the covariance of its prediction."""


class RobustFilterMatch(FilterMatch, RobustMatch):
    """A match with a robust kernel that updates a filter."""


class ScanToScanParams(eqx.Module):
    """Matches of a scan with the scan before it."""

    radius: Scalar = leaf(5.0, "m", above=0)
    """Matched points have to be nearer to each other than this."""
    rings_apart: Scalar = leaf(2.5, "rings", above=0, most=3)
    """The second and third point of a match are fewer rings than this away from the ring of the nearest
    point; at most 3."""


class KnnParams(eqx.Module):
    """Fits through the nearest neighbours of a point in the map."""

    radius: Scalar = leaf(5**0.5, "m", above=0)
    """The farthest neighbour has to be nearer than this."""
    plane_tolerance: Scalar = leaf(0.1, "m", above=0)
    """All neighbours have to lie within this distance of their plane."""


class LineFitParams(KnnParams):
    """Lines and planes."""

    line_ratio: Scalar = leaf(3.0, above=0)
    """Neighbours make a line if their largest variance exceeds the second largest by this factor."""


class ScoredFitParams(KnnParams):
    """Matches with a score, as FAST-LIO2 and LIO-SAM have them."""

    distance_weight: Scalar = leaf(0.9, least=0, tuned="log")
    """Weight w of the score 1 - w |d| / sqrt(r) of a match, with the distance d from the plane and the range
    r, both in m."""
    min_score: Scalar = leaf(0.9, least=0, most=1)
    """A match counts if its score is above this."""


class ScoredPlaneFitParams(ScoredFitParams):
    """Planes with scores, as FAST-LIO2 and LIO-SAM have them."""

    least_width: Scalar = leaf(0.4, least=0)
    """Neighbours whose second largest standard deviation is below this share of the map's voxel size lie on a
    line, such as a sensor's ring on the ground, and define no plane. 0 with FAST-LIO2 and LIO-SAM themselves,
    and without inertial samples."""


class ScoredLineFitParams(LineFitParams, ScoredPlaneFitParams):
    """Lines and planes with scores, as LIO-SAM has them."""


@dataclass(frozen=True)
class RegistrationConfig:
    """Bounds of the scan match."""

    max_iterations: int = static(60, above=0)
    """Largest number of Gauss-Newton steps, or of filter updates."""
    mark_matched: bool = static(False)
    """State in the output which points were matched. With ``config.output.clouds``, a run then writes these
    as well."""


@dataclass(frozen=True)
class KnnConfig:
    """Matching by nearest neighbours."""

    neighbours: int = static(5, least=3, why="fewer points define no plane")
    """Number of map points through which a plane is fitted."""
