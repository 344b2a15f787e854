"""Prepare recorded poses, samples and fixes as the measurements of a fusion, with a first guess."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.types import ImuBatch, state_dtype
from lio_jax.data.sequence import GpsData, ImuData
from lio_jax.data.trajectory import Trajectory
from lio_jax.fusion.params import FusionParams
from lio_jax.fusion.problem import Fixes, FusedStates, Problem, UnitCovariances
from lio_jax.fusion.start import first_guess
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import Preintegrated, preintegrate_parallel
from lio_jax.imu.sampling import sample_intervals

_Array = NDArray[np.float64]

GUESSED_ROTATION = 0.1
"""Standard deviation of T_imu_sensor's rotation, rad, from which on the motion gives the first guess."""
FARTHEST_FIX_S = 2.0
"""A fix between two poses that are farther apart in time, s, is left out."""
_SIZES = (8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192)
_LEAST_POSES = 5
_AT_ONCE = 256


def prepare_fusion(
    odometry: Trajectory, imu: ImuData, gps: GpsData | None, params: FusionParams
) -> tuple[Problem, FusedStates]:
    """Return the measurements and a first guess of the unknowns.

    Poses outside of the samples' span are left out, and so are fixes outside of the poses' span.

    Args:
        odometry: poses of the odometry's sensor in its world.
        imu: samples with ascending stamps, rad/s and m/s^2.
        gps: fixes in a local level frame, or None.
        params: noise, priors and calibration.

    Raises:
        LioJaxError: the spans of time do not overlap, or fewer than five poses are left.
    """
    odometry = within(odometry, imu)
    time, origin = _seconds(odometry.stamp_ns)
    samples = np.asarray((imu.stamp_ns - origin) * 1e-9, np.float64)
    index, mask = _rows(time, samples)
    batch = _batches(time, samples, imu, index, mask)
    biases = jnp.zeros((2, 3), state_dtype())
    links, covariance = preintegrated(batch, jnp.diff(jnp.asarray(time)), biases, params.imu)
    gyro = np.stack([np.interp(time, samples, imu.gyro[:, axis]) for axis in range(3)], axis=1)
    fixes = _fixes(gps, odometry, params)
    problem, states = first_guess(odometry.poses, time, gyro, links, covariance, fixes, params)
    # the increments depend on the biases to first order only, so they are made again with the first guess
    links, covariance = preintegrated(
        batch, jnp.diff(problem.time), states.motion[0, 10:16].reshape(2, 3), params.imu
    )
    return eqx.tree_at(lambda p: (p.imu, p.covariance), problem, (links, covariance)), states


def within(odometry: Trajectory, imu: ImuData) -> Trajectory:
    """Return the poses within the samples' span, without those that are not finite.

    Raises:
        LioJaxError: there are fewer than five.
    """
    finite = odometry.finite()
    kept = (finite.stamp_ns >= imu.stamp_ns[0]) & (finite.stamp_ns <= imu.stamp_ns[-1])
    if kept.sum() < _LEAST_POSES:
        spans = [
            f"{stamps[0] * 1e-9:.3f} to {stamps[-1] * 1e-9:.3f} s" if len(stamps) else "no time"
            for stamps in (finite.stamp_ns, imu.stamp_ns)
        ]
        raise LioJaxError(
            f"{kept.sum()} poses lie within the time of the inertial samples, and {_LEAST_POSES} are needed: "
            f"the poses cover {spans[0]}, the samples {spans[1]}; give both in the same clock."
        )
    return Trajectory(finite.stamp_ns[kept], finite.poses[kept])


def _seconds(stamp_ns: NDArray[np.int64]) -> tuple[_Array, int]:
    origin = int(stamp_ns[0])
    return np.asarray((stamp_ns - origin) * 1e-9, np.float64), origin


def _rows(time: _Array, samples: _Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the indices of each link's samples and of one on either side, padded, and their mask."""
    first = np.maximum(np.searchsorted(samples, time[:-1], "right") - 1, 0)
    last = np.minimum(np.searchsorted(samples, time[1:], "left"), len(samples) - 1)
    most = int((last - first).max()) + 1
    size = next((size for size in _SIZES if size >= most), most)
    index = first[:, None] + np.arange(size)
    mask = index <= last[:, None]
    return np.where(mask, index, first[:, None]), mask


def _batches(
    time: _Array, samples: _Array, imu: ImuData, index: NDArray[np.intp], mask: NDArray[np.bool_]
) -> ImuBatch:
    dtype = state_dtype()
    relative = samples[index] - time[:-1, None]
    seconds, gyro, accel = (
        jnp.asarray(rows, dtype) for rows in (relative, imu.gyro[index], imu.accel[index])
    )
    return ImuBatch(seconds, gyro, accel, jnp.asarray(mask))


@jax.jit
def preintegrated(
    batch: ImuBatch, duration: jax.Array, biases: jax.Array, params: ImuParams
) -> tuple[Preintegrated, UnitCovariances]:
    """Return the preintegrated links, and their covariances as a sum over squared densities.

    Args:
        batch: samples of each of m links, (m, k); times from the link's start, s.
        duration: (m,) length of each link, s.
        biases: (2, 3) of gyroscope (rad/s) and accelerometer (m/s^2).
        params: gravity is used; the densities are replaced.
    """
    fields = lambda p: (p.gyro_noise, p.accel_noise, p.gyro_bias_walk, p.accel_bias_walk)  # noqa: E731
    zero = jnp.zeros((), duration.dtype)

    def link(row: tuple[ImuBatch, jax.Array]) -> tuple[Preintegrated, jax.Array, jax.Array]:
        samples, length = row
        intervals = sample_intervals(samples, zero, zero, length)

        def of(densities: jax.Array) -> Preintegrated:
            noise = eqx.tree_at(fields, params, tuple(densities))
            return preintegrate_parallel(intervals, biases[0], biases[1], noise)

        made = of(jnp.zeros(4, duration.dtype))
        unit = jax.vmap(lambda densities: of(densities).covariance)(jnp.eye(4, dtype=duration.dtype))
        return made, unit - made.covariance, made.covariance

    links, unit, rest = jax.lax.map(link, (batch, duration), batch_size=_AT_ONCE)
    return links, UnitCovariances(jnp.swapaxes(unit, 0, 1), rest)


def _fixes(gps: GpsData | None, odometry: Trajectory, params: FusionParams) -> Fixes:
    dtype = state_dtype()
    if gps is None:
        none = jnp.zeros((0, 3), dtype)
        return Fixes(jnp.zeros(0, jnp.int32), jnp.zeros(0, dtype), none, none)
    stamps = odometry.stamp_ns
    inside = (gps.stamp_ns >= stamps[0]) & (gps.stamp_ns < stamps[-1])
    link = np.clip(np.searchsorted(stamps, gps.stamp_ns, "right") - 1, 0, len(stamps) - 2)
    length = (stamps[link + 1] - stamps[link]) * 1e-9
    inside &= length <= FARTHEST_FIX_S
    if not inside.any():
        raise LioJaxError(
            f"no GPS fix lies within the poses' time: the poses cover {stamps[0] * 1e-9:.3f} to "
            f"{stamps[-1] * 1e-9:.3f} s, the fixes {gps.stamp_ns[0] * 1e-9:.3f} to "
            f"{gps.stamp_ns[-1] * 1e-9:.3f} s; give both in the same clock."
        )
    gps = replace(
        gps,
        stamp_ns=gps.stamp_ns[inside],
        position=gps.position[inside],
        covariance=gps.covariance[inside],
    )
    link, length = link[inside], length[inside]
    share = (gps.stamp_ns - stamps[link]) * 1e-9 / length
    sigma = np.sqrt(np.diagonal(gps.covariance, axis1=1, axis2=2))
    sigma = np.where(np.isfinite(sigma) & (sigma > 0), sigma, np.asarray(params.gps.sigma))
    return Fixes(
        jnp.asarray(link, jnp.int32),
        jnp.asarray(share, dtype),
        jnp.asarray(gps.position, dtype),
        jnp.asarray(sigma, dtype),
    )
