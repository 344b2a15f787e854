"""Parameters of the sliding-window smoother."""

import equinox as eqx

from lio_jax.core.leaf import leaf
from lio_jax.core.types import Scalar


class SmootherParams(eqx.Module):
    """How a scan match enters the smoother, and how the smoother's pose enters the next scan match."""

    rotation_sigma: Scalar = leaf(0.05, "rad", above=0, tuned="log")
    """Standard deviation of a scan match's rotation, where the sigmas are fixed."""
    translation_sigma: Scalar = leaf(0.1, "m", above=0, tuned="log")
    """Standard deviation of a scan match's position, where the sigmas are fixed."""
    degenerate_sigma: Scalar = leaf(1.0, "rad and m", above=0, tuned="log")
    """Standard deviation of a degenerate scan match's rotation and position."""
    kernel: Scalar = leaf(1e6, "sigmas", above=0, tuned="log")
    """Scale of the robust kernel on scan matches. It is wide: a narrow kernel would reject all matches once
    the velocity is wrong."""
    position_sigma: Scalar = leaf(0.01, "m", above=0, tuned="log")
    """Standard deviation of the first position."""
    tolerance: Scalar = leaf(1e-3, "sigmas", above=0)
    """The smoother has converged when the next step would be shorter than this."""
    tilt_weight: Scalar = leaf(0.01, least=0, most=1, tuned="log")
    """Share by which the matched roll and pitch are moved to the inertial ones."""
    tilt_limit: Scalar = leaf(1000.0, "rad", above=0)
    """Larger roll and pitch are clipped to this."""
    height_limit: Scalar = leaf(1000.0, "m", above=0)
    """Larger absolute z is clipped to this."""
    mapping_interval: Scalar = leaf(0.0, "s", least=0)
    """Smallest time between two scan matches. In between the pose is the inertial prediction."""
