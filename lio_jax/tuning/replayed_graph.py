"""A run's corrected trajectory and likelihood as functions of the back end's parameters, its choices held.

Which keyframes, loops and fixes enter the graph, and which of them a robust solve rejects, are choices. They
are those of a run of the back end. The odometry is a constant, too. What is left is a pose graph whose
weights and levers depend on the parameters, and whose solution has a derivative
(:mod:`lio_jax.pose_graph.pose_derivative`).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from lio_jax.loops.back_end import Correction, between_keyframes, graph_of
from lio_jax.loops.edge_noise import fix_covariance, loop_covariance, odometry_covariance
from lio_jax.pose_graph.factors import edge_costs
from lio_jax.pose_graph.graph import LOOP, ODOMETRY, POSITION, PoseGraph, Poses, picked, poses_from
from lio_jax.pose_graph.log_determinant import log_determinant
from lio_jax.pose_graph.pose_derivative import solved_poses
from lio_jax.settings.shared import GlobalParams

_BELIEVED = 0.5
"""Weight above which the back end uses an edge in its last solve."""


class ReplayedGraph(eqx.Module):
    """The graph at the end of a run, with n poses of the odometry between its k keyframes."""

    graph: PoseGraph
    """The e edges that the last solve used, with their weights at the run's parameters."""
    stated: Float[Array, "e 6 6"]
    """Part of each edge's covariance that does not depend on the parameters."""
    depends: Bool[Array, " e"]
    """Whether the rest depends on them; otherwise the edge keeps its weight."""
    keyframes: Poses
    """(k,) T_odom_keyframe, m."""
    odometry: Poses
    """(n,) T_odom_imu, m."""
    before: Int[Array, " n"]
    """Keyframe before each pose; the first one for poses before it."""
    after: Int[Array, " n"]
    """Keyframe after each pose; the last one for poses after it."""
    share: Float[Array, " n"]
    """Share of the time from the keyframe before to the one after, 0 to 1."""
    aligned: bool = eqx.field(static=True)
    """Whether the graph is in the frame of the fixes."""
    elevation: bool = eqx.field(static=True)
    """Whether the height of the fixes is used."""

    @property
    def closed(self) -> bool:
        """Return whether a loop or a fix contradicts the odometry; without them the cost is zero."""
        return bool(np.isin(np.asarray(self.graph.kind), (LOOP, POSITION)).any())

    def corrected(self, params: GlobalParams) -> Float[Array, "n 7"]:
        """Return the corrected poses T_world_imu: quaternion w, x, y, z and translation, m."""
        return _interpolated(self, solved_poses(_weighted(self, params)))

    def negative_log_evidence(self, params: GlobalParams) -> Float[Array, ""]:
        """Return minus the log marginal likelihood of the graph's measurements, by Laplace's approximation.

        At the poses of least cost it is ``cost - sum(log det Omega) / 2 + log det H / 2``, with the
        information Omega of the edges and the Hessian H of the cost by the free poses (MacKay, "Information
        theory, inference, and learning algorithms", 2003, chapter 27). H is that of Gauss-Newton, which has
        no negative eigenvalue and is exact where measurements are linear in the poses. The derivative is that
        of this number, H at the poses of least cost included. The prior of the poses is flat.

        Left out is what no parameter changes: the powers of 2 pi, and log det Omega of the edges that keep
        their weight. So only differences of this number have a meaning. It is NaN where H is not positive
        definite. Call it outside of ``jit``, because the host finds the solution.
        """
        graph = _weighted(self, params)
        poses = solved_poses(graph)
        return _misfit(self.depends, graph, poses) + log_determinant(poses, graph) / 2


def replayed_graph(
    found: Correction, stamp_ns: NDArray[np.int64], T_odom_imu: NDArray[np.float64], elevation: bool
) -> ReplayedGraph:
    """Return the graph of a run.

    Args:
        found: result of the back end, with at least one keyframe.
        stamp_ns: (n,) times of the odometry's poses, ns.
        T_odom_imu: (n, 4, 4) poses of the odometry, m.
        elevation: ``config.backend.gps_elevation``.
    """
    used = [edge for edge, weight in zip(found.edges, found.weights, strict=True) if weight > _BELIEVED]
    aligned = found.T_enu_world is not None
    poses = found.T_world_imu if found.T_enu_world is None else found.T_enu_world @ found.T_world_imu
    before, after, share = between_keyframes(stamp_ns, found.stamp_ns)
    stated = [np.zeros((6, 6)) if edge.stated is None else edge.stated for edge in used]
    return ReplayedGraph(
        graph=graph_of(poses, used),
        stated=jnp.asarray(np.array(stated).reshape(-1, 6, 6)),
        depends=jnp.asarray(np.array([edge.stated is not None for edge in used], bool)),
        keyframes=_se3(found.T_odom_imu),
        odometry=_se3(T_odom_imu),
        before=jnp.asarray(before),
        after=jnp.asarray(after),
        share=jnp.asarray(share),
        aligned=aligned,
        elevation=elevation,
    )


def _se3(poses: NDArray[np.float64]) -> Poses:
    return poses_from(poses[:, :3, :3], poses[:, :3, 3])


@jax.jit
def _weighted(replayed: ReplayedGraph, params: GlobalParams) -> PoseGraph:
    """Return the graph with the weights and the lever of the parameters."""
    graph, backend, loop, gps = replayed.graph, params.backend, params.loop, params.gps
    by_odometry = odometry_covariance(
        replayed.stated,
        backend.odometry_rotation_sigma,
        backend.odometry_translation_sigma,
        backend.odometry_scale,
    )
    by_loop = loop_covariance(replayed.stated, loop.rotation_sigma, loop.translation_sigma)
    by_fix = fix_covariance(
        replayed.stated[:, 3:, 3:], replayed.elevation, gps.min_variance, gps.height_variance, jnp
    )
    information = graph.information
    for kind, covariance in ((ODOMETRY, by_odometry), (LOOP, by_loop), (POSITION, by_fix)):
        size = covariance.shape[-1]
        mine = ((graph.kind == kind) & replayed.depends)[:, None, None]
        # other kinds may have no such covariance
        inverse = jnp.linalg.inv(jnp.where(mine, covariance, jnp.eye(size)))
        information = jnp.where(mine, jnp.pad(inverse, ((0, 0), *[(6 - size, 0)] * 2)), information)
    lever = jnp.broadcast_to(gps.lever_arm, (len(graph.kind), 3)).astype(information.dtype)
    return eqx.tree_at(lambda graph: (graph.information, graph.lever), graph, (information, lever))


@jax.jit
def _misfit(depends: Bool[Array, " e"], graph: PoseGraph, poses: Poses) -> Float[Array, ""]:
    """Return the cost less half of the log-determinants of the information that depends on parameters."""
    # a position has no rows for the rotation
    turns = jnp.arange(6) < 3
    no_row = jnp.where((graph.kind == POSITION)[:, None] & turns, 1.0, 0.0)
    information = graph.information + no_row[:, None] * jnp.eye(6)
    log_det = jnp.linalg.slogdet(jnp.where(depends[:, None, None], information, jnp.eye(6)))[1]
    return jnp.sum(edge_costs(poses, graph)) - jnp.sum(log_det) / 2


@jax.jit
def _interpolated(replayed: ReplayedGraph, solved: Any) -> Float[Array, "n 7"]:
    """Return the corrected poses as :func:`lio_jax.loops.back_end.corrected_poses` does."""
    if replayed.aligned:
        solved = _levelled(solved, replayed.keyframes) @ solved
    T_world_odom = solved @ replayed.keyframes.inverse()
    seen_before: Any = picked(T_world_odom, replayed.before) @ replayed.odometry
    seen_after: Any = picked(T_world_odom, replayed.after) @ replayed.odometry
    share = replayed.share[:, None]
    turn = (seen_before.rotation().inverse() @ seen_after.rotation()).log()
    rotation = seen_before.rotation() @ jaxlie.SO3.exp(share * turn)
    shift = share * (seen_after.translation() - seen_before.translation())
    return jnp.concatenate([rotation.wxyz, seen_before.translation() + shift], -1)


def _levelled(solved: Poses, keyframes: Poses) -> jaxlie.SE3:
    """Return T_world_enu as :func:`lio_jax.loops.back_end.levelled_onto` does for the first keyframe."""
    T_enu, T_world = (jax.tree.map(lambda leaf: leaf[:1], poses) for poses in (solved, keyframes))
    between = (T_world.rotation() @ T_enu.rotation().inverse()).as_matrix()[0]
    yaw = jnp.arctan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1])
    turn = jaxlie.SO3.from_z_radians(yaw[None])
    return jaxlie.SE3.from_rotation_and_translation(
        turn, T_world.translation() - turn.apply(T_enu.translation())
    )
