"""Checked GPS fixes: finite, ascending in time, each with a covariance; and sentences on what was wrong."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.sequence import GpsData
from lio_jax.data.time_order import ascending

_UNSTATED_SIGMA = (5.0, 5.0, 10.0)
"""Assumed standard deviations where the recording states no covariance: those of a plain receiver, m, ENU."""
_ROUNDING = 1e-3
"""Largest accepted asymmetry of a covariance, as a share of its trace."""
_FARTHEST = 1e6
"""A position farther than this from the frame's origin is a fault of the recording, m."""


def cleaned(gps: GpsData, source: str) -> tuple[GpsData, tuple[str, ...]]:
    """Drop fixes that cannot be used, give each one a covariance, and report the changes.

    A fix is dropped if its position is not finite or impossibly far away, if it is at (0, 0) because the
    receiver has no frame yet, or if its stamp repeats or steps back. An invalid covariance counts as unknown.

    Args:
        gps: fixes in recorded order.
        source: file or topic, with which the sentences begin.

    Raises:
        LioJaxError: stamps, positions and covariances differ in length.
    """
    count = len(gps.stamp_ns)
    if gps.position.shape != (count, 3) or gps.covariance.shape != (count, 3, 3):
        raise LioJaxError(
            f"{source}: {count} GPS stamps, but positions of shape {gps.position.shape} and covariances of "
            f"shape {gps.covariance.shape}; write (n, 3) and (n, 3, 3)."
        )
    messages = []
    possible = np.asarray((np.abs(gps.position) < _FARTHEST).all(axis=1))
    if not possible.all():
        messages.append(f"{np.sum(~possible)} GPS fix(es) without a possible position were left out.")
    if not np.isfinite(gps.origin).all():
        unset = possible & ~gps.position[:, :2].any(axis=1)
        if unset.any():
            messages.append(
                f"{np.sum(unset)} GPS fix(es) at (0, 0) were left out: the receiver had none yet."
            )
        possible &= ~unset
    gps = _at(gps, np.flatnonzero(possible))
    kept = np.array(ascending(gps.stamp_ns.tolist()), np.int64)
    if len(kept) < len(gps.stamp_ns):
        messages.append(
            f"{len(gps.stamp_ns) - len(kept)} GPS fix(es) whose stamp repeats, steps back or leaps ahead "
            "were left out."
        )
    gps = _at(gps, kept)
    covariance, unstated = with_covariances(gps.covariance)
    if unstated:
        messages.append(f"{unstated}.")
    return replace(gps, covariance=covariance), tuple(f"{source}: {sentence}" for sentence in messages)


def with_covariances(covariance: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """Replace invalid covariances by a plain receiver's, and return a sentence on it; "" where all are valid.

    A covariance is invalid if it is not finite or impossibly large, not symmetric or not positive definite,
    for example all zeros.

    Args:
        covariance: (n, 3, 3) m^2, east, north, up.
    """
    # the negated comparison also covers NaN
    possible = np.asarray((np.abs(covariance) < _FARTHEST**2).all(axis=(1, 2)))
    own = np.where(possible[:, None, None], covariance, 0.0)
    turned = own.transpose(0, 2, 1)
    skewed = np.abs(own - turned).max(axis=(1, 2), initial=0.0)
    scale = np.trace(own, axis1=1, axis2=2)
    own = (own + turned) / 2
    stated = np.asarray((skewed <= _ROUNDING * scale) & (np.linalg.eigvalsh(own)[:, 0] > 0))
    if stated.all():
        return own, ""
    note = (
        f"{np.sum(~stated)} of {len(stated)} fixes state no covariance: "
        f"{_UNSTATED_SIGMA[0]:g} m horizontally and {_UNSTATED_SIGMA[2]:g} m vertically were assumed"
    )
    return np.where(stated[:, None, None], own, np.diag(np.square(_UNSTATED_SIGMA))), note


def _at(gps: GpsData, index: NDArray[np.int64]) -> GpsData:
    return replace(
        gps, stamp_ns=gps.stamp_ns[index], position=gps.position[index], covariance=gps.covariance[index]
    )
