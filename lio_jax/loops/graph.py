"""Pose graphs as pytrees of arrays.

Tangents of poses, rows and columns of information matrices and covariances count rotation (rad) before
translation (m): (rx, ry, rz, x, y, z) in space, (angle, x, y) in the plane. They belong to right
perturbations, T exp(d).
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

Poses = jaxlie.SEBase
"""SE3 or SE2, all of one kind, with one batch axis."""

ODOMETRY, LOOP, PRIOR, POSITION = range(4)
"""Kinds of edge. A prior states a vertex's pose, a position where a point fixed to it is, such as a GPS
antenna."""


class PoseGraph(eqx.Module):
    """Vertices and what was measured about them."""

    poses: Poses
    """(n,) estimates, T_world_vertex."""
    i: Int[Array, " e"]
    """First vertex of each edge; of a prior and of a position the same as ``j``."""
    j: Int[Array, " e"]
    """Second vertex."""
    measurement: Poses
    """(e,) T_i_j; T_world_j of a prior; of a position only the translation counts."""
    information: Float[Array, "e d d"]
    """Inverse covariance of the measurement's right perturbation; of a position, of its coordinates in the
    world, with zeros for the rotation."""
    kind: Int[Array, " e"]
    """ODOMETRY, LOOP, PRIOR or POSITION."""
    fixed: Bool[Array, " n"]
    """Vertices that keep their pose."""
    lever: Float[Array, "e k"] | None = None
    """Of a position: the point whose place was measured, in the frame of ``j``, m; of other edges not looked
    at. None: all positions are those of the vertices' own origins."""


Status = Literal["converged", "iteration limit", "no further decrease", "not finite"]
"""How a solve ended. "no further decrease": no step, however short, lowered the cost."""


class Solution(eqx.Module):
    """What a solve found."""

    poses: Poses
    """(n,) T_world_vertex."""
    cost: Float[Array, ""]
    """Half the weighted sum of squared whitened residuals."""
    weights: Float[Array, " e"]
    """Of each edge's information: 1, or below where a robust solve distrusts an edge."""
    edge_costs: Float[Array, " e"]
    """r' Omega r / 2 of each edge, whatever its weight."""
    initial_cost: Float[Array, ""]
    """Cost of the graph's own poses, all edges trusted."""
    iterations: int = eqx.field(static=True)
    """Linear systems solved."""
    status: Status = eqx.field(static=True)


def rotation_first(tangent_or_matrix: Float[Array, "*b"], axes: int = 1) -> Float[Array, "*b"]:
    """Return jaxlie's tangents (translation first) in this project's order.

    Args:
        tangent_or_matrix: its last ``axes`` axes are of a tangent's size, 6 or 3.
        axes: 1 for tangents, 2 for matrices.
    """
    size = tangent_or_matrix.shape[-1]
    return jnp.roll(tangent_or_matrix, 3 if size == 6 else 1, axis=tuple(range(-axes, 0)))


def moved(poses: Poses, step: Float[Array, "n d"]) -> Poses:
    """Return T exp(step)."""
    size = step.shape[-1]
    return poses @ type(poses).exp(jnp.roll(step, -3 if size == 6 else -1, axis=-1))


def between(a: Poses, b: Poses) -> Poses:
    """Return a^-1 b, of (n,) and (n,) poses.

    In space column by column: each of jaxlie's own products, of quaternions and with points, costs XLA
    as much as all of this.
    """
    if not isinstance(a, jaxlie.SE3):
        return a.inverse() @ b
    (numbers_a,), (numbers_b,) = jax.tree.leaves(a), jax.tree.leaves(b)
    w, x, y, z, *from_t = jnp.moveaxis(numbers_a, -1, 0)
    p, q, r, s, *to_t = jnp.moveaxis(numbers_b, -1, 0)
    turn = [
        w * p + x * q + y * r + z * s,
        w * q - x * p - y * s + z * r,
        w * r - y * p - z * q + x * s,
        w * s - z * p - x * r + y * q,
    ]
    # R' v = v - 2 w (u x v) + 2 u x (u x v) with u the quaternion's vector
    vx, vy, vz = (to - start for to, start in zip(to_t, from_t, strict=True))
    cx, cy, cz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    shift = [
        vx + 2 * (y * cz - z * cy - w * cx),
        vy + 2 * (z * cx - x * cz - w * cy),
        vz + 2 * (x * cy - y * cx - w * cz),
    ]
    return jaxlie.SE3(jnp.stack(turn + shift, -1))


def picked(poses: Poses, index: Int[Array, " k"]) -> Poses:
    """Return the poses at these places."""
    return jax.tree.map(lambda leaf: leaf[index], poses)


def tangent_size(poses: Poses) -> int:
    """Return 6 in space, 3 in the plane."""
    return poses.tangent_dim
