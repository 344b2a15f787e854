"""Align the points of one place with those of another, from several first guesses, on the device.

Each guess is refined first with a coarse map of the target, then with a fine one.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Float32
from numpy.typing import NDArray

from lio_jax.core.types import CONVERGED
from lio_jax.loops.params import AlignmentParams
from lio_jax.mapping.voxel_map import VoxelMap, empty_map, insert
from lio_jax.pose_graph.graph import poses_from, rotation_matrices
from lio_jax.registration.gauss_newton import Registration, gauss_newton
from lio_jax.registration.scan_match import FixedPoints
from lio_jax.registration.voxel_planes import ScanToVoxels

_CAPACITY = 65536
"""Number of voxels of the target's map."""
_COARSE = 2.0
"""Size of the coarse map's voxels over that of the fine map's."""
_COARSE_ERROR, _FINE_ERROR = 1.5, 0.5
"""Error of the guesses and of the coarse result, m; the robust kernel is wide enough for it."""
_ITERATIONS = 30
"""Largest number of iterations with each map."""
_REACH = 1e5
"""Distance beyond which the map may forget a voxel, m: larger than any, so that none is forgotten."""


class Alignments(NamedTuple):
    """The results of n guesses."""

    T_target_source: NDArray[np.float64]
    """(n, 4, 4) aligned poses of the source in the target's frame, m."""
    information: NDArray[np.float64]
    """(n, 6, 6) inverse covariance of the right perturbation, rotation (rad) before translation (m), as if
    the errors of all points were independent."""
    degenerate: NDArray[np.bool_]
    """(n,) True where a direction is not observable."""
    converged: NDArray[np.bool_]
    """(n,) True where the alignment converged."""


def aligned(
    target: NDArray[np.float32],
    target_mask: NDArray[np.bool_],
    source: NDArray[np.float32],
    source_mask: NDArray[np.bool_],
    guesses: NDArray[np.float64],
    most: int,
    params: AlignmentParams,
) -> Alignments:
    """Return the alignment from each of n guesses.

    Args:
        target: (m, 3) points of the target, m, padded to a fixed size.
        target_mask: (m,) which rows of ``target`` are real.
        source: (k, 3) points of the source, m, padded to a fixed size.
        source_mask: (k,) which rows of ``source`` are real.
        guesses: (n, 4, 4) T_target_source, m; at most ``most`` of them.
        most: number of guesses for which the program is compiled.
        params: parameters of registration; ``params.map.voxel_size`` is that of the fine map.
    """
    count = len(guesses)
    padded = np.concatenate([guesses, np.repeat(guesses[:1], most - count, axis=0)])
    starts = poses_from(padded[:, :3, :3], padded[:, :3, 3])
    result = _aligned(target, target_mask, source, source_mask, starts, jnp.int32(count), params)
    T, information, degenerate, status = jax.device_get(
        (result.T_world_lidar.wxyz_xyz, result.information, result.degenerate, result.status)
    )
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, :3, :3] = rotation_matrices(jaxlie.SE3(T[:count]))
    found[:, :3, 3] = T[:count, 4:]
    return Alignments(found, information[:count], degenerate[:count].any(axis=1), status[:count] == CONVERGED)


@jax.jit
def _aligned(
    target: Float32[Array, "m 3"],
    target_mask: Bool[Array, " m"],
    source: Float32[Array, "k 3"],
    source_mask: Bool[Array, " k"],
    starts: jaxlie.SE3,
    count: Array,
    params: AlignmentParams,
) -> Registration:
    def stage(starts: jaxlie.SE3, voxel_size: Float[Array, ""], error: float) -> Registration:
        sized = eqx.tree_at(lambda map_params: map_params.voxel_size, params.map, voxel_size)
        vmap = _map_of(target, target_mask, voxel_size)
        dtype = starts.wxyz_xyz.dtype

        def one(case: tuple[Array, Array]) -> Registration:
            number, start = case
            # padded guesses have no points, so they cost nothing
            mask = source_mask & (number < count)
            match = ScanToVoxels(
                points_at=FixedPoints(source),
                T_predicted=jaxlie.SE3(start),
                registration=params.registration,
                map=vmap,
                mask=mask,
                prediction_error=jnp.asarray(error, dtype),
                map_params=sized,
                lidar=params.lidar,
            )
            return gauss_newton(match, _ITERATIONS)

        # one after the other: each stops where it has converged
        return jax.lax.map(one, (jnp.arange(len(starts.wxyz_xyz)), starts.wxyz_xyz))

    first = stage(starts, _COARSE * params.map.voxel_size, _COARSE_ERROR)
    return stage(first.T_world_lidar, params.map.voxel_size, _FINE_ERROR)


def _map_of(points: Float32[Array, "m 3"], mask: Bool[Array, " m"], voxel_size: Float[Array, ""]) -> VoxelMap:
    vmap, _ = insert(
        empty_map(_CAPACITY),
        points,
        mask,
        jnp.zeros(3, jnp.int32),
        voxel_size.astype(jnp.float32),
        jnp.float32(_REACH),
    )
    return vmap
