"""Covariances of the back end's edges, as functions of the parameters.

The functions work with numpy, and with jax.numpy where the derivative by the parameters is wanted. Each takes
the part of the covariance that no parameter changes, and adds that of the parameters.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.geometry import carried

_Array = NDArray[np.float64]

_ARM = 10.0
"""Distance of a point by whose displacement a rotation is compared with a translation, m."""


def stated_growth(before: _Array, after: _Array, T_after_before: _Array) -> _Array:
    """Return the (6, 6) covariance of the odometry's error since an earlier pose, as the estimator states it.

    The errors of the two poses are e and A e + d, with A the adjoint of T_after_before. If the new error d
    does not depend on e, its covariance is the growth S_after - A S_before A'. The sum over a chain of poses
    is then the growth of the estimator's covariance from the first to the last. Along some directions a match
    lowers the covariance. There d depends on e, and the growth counts as zero, so that the sum is not smaller
    than what the estimator states.

    Args:
        before: (6, 6) covariance of the earlier pose in world: right perturbation, rotation (rad) before
            translation (m).
        after: (6, 6) covariance of the later pose.
        T_after_before: (4, 4) earlier pose in the frame of the later one, m.
    """
    unit = np.repeat([1 / _ARM, 1.0], 3)
    growth = (after - carried(before, T_after_before)) / np.outer(unit, unit)
    values, vectors = np.linalg.eigh((growth + growth.T) / 2)
    grown = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray((grown + grown.T) / 2 * np.outer(unit, unit))


def odometry_covariance(stated: Any, rotation_sigma: Any, translation_sigma: Any, scale: Any) -> Any:
    """Return the (..., 6, 6) covariance between two keyframes by the odometry.

    Args:
        stated: (..., 6, 6) see :func:`stated_growth`; zero where the estimator states nothing.
        rotation_sigma: rad, ``params.backend.odometry_rotation_sigma``.
        translation_sigma: m, ``params.backend.odometry_translation_sigma``.
        scale: ``params.backend.odometry_scale``.
    """
    return scale**2 * stated + _variances(rotation_sigma, translation_sigma)


def loop_covariance(stated: Any, rotation_sigma: Any, translation_sigma: Any) -> Any:
    """Return the (..., 6, 6) covariance of a loop.

    Args:
        stated: (..., 6, 6) covariance that the alignment of the points states.
        rotation_sigma: rad, ``params.loop.rotation_sigma``.
        translation_sigma: m, ``params.loop.translation_sigma``.
    """
    return stated + _variances(rotation_sigma, translation_sigma)


def fix_covariance(
    stated: Any, elevation: bool, min_variance: Any, height_variance: Any, xp: Any = np
) -> Any:
    """Return the (..., 3, 3) covariance of a fix: its variances are raised to the least one.

    Args:
        stated: (..., 3, 3) covariance that the receiver states, m^2.
        elevation: True: the height is that of the fix. False: it is that of the odometry.
        min_variance: m^2, ``params.gps.min_variance``.
        height_variance: m^2, ``params.gps.height_variance``.
        xp: numpy or jax.numpy.
    """
    if not elevation:
        level = np.diag([1.0, 1.0, 0.0])
        stated = level @ stated @ level + height_variance * np.diag([0.0, 0.0, 1.0])
    lacking = xp.maximum(min_variance - xp.diagonal(stated, axis1=-2, axis2=-1), 0.0)
    return stated + lacking[..., None] * np.eye(3)


def _variances(rotation_sigma: Any, translation_sigma: Any) -> Any:
    turn, shift = np.diag([1.0] * 3 + [0.0] * 3), np.diag([0.0] * 3 + [1.0] * 3)
    return rotation_sigma**2 * turn + translation_sigma**2 * shift
