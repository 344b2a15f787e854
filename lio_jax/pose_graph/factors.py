"""Residuals of a pose graph's edges, their cost and its linearisation.

The cost is half the sum of r' Omega r, with r = Log(Z^-1 T_i^-1 T_j) by the group's logarithm. This is the
error of gtsam's BetweenFactor and PriorFactor, in space and in the plane. The program g2o uses the sum
without the factor 1/2, and residuals that are not logarithms.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import zeta

from lio_jax.core.geometry import skew
from lio_jax.core.xla import computed_once
from lio_jax.pose_graph.graph import POSITION, PRIOR, PoseGraph, Poses, between, moved, picked, rotation_first

_SERIES_BELOW = 0.3
"""Angle, rad, below which the closed forms of the coefficients cancel, so that their series are used."""


class Linearised(NamedTuple):
    """The part of each edge in the normal equations H dx = -g of a step of right perturbations."""

    cost: Float[Array, " e"]
    """r' Omega r / 2 of each edge."""
    H_ii: Float[Array, "e d d"]
    """Block of H for the edge's first vertex."""
    H_ij: Float[Array, "e d d"]
    """Block of H with the rows of the first vertex and the columns of the second."""
    H_jj: Float[Array, "e d d"]
    """Block of H for the edge's second vertex."""
    g_i: Float[Array, "e d"]
    """Gradient for the first vertex."""
    g_j: Float[Array, "e d"]
    """Gradient for the second vertex."""

    def blocks(self) -> Float[Array, "e h h"]:
        """Return each edge's part of H, h = 2 d: the d rows of the first vertex, then those of the second."""
        return jnp.block([[self.H_ii, self.H_ij], [_turned(self.H_ij), self.H_jj]])


def residuals(T_world_i: Poses, T_world_j: Poses, graph: PoseGraph) -> Float[Array, "e d"]:
    """Return Log(Z^-1 T_i^-1 T_j) of each edge, Log(Z^-1 T_j) of a prior, (0, T_j l - z) of a position.

    Args:
        T_world_i: (e,) poses of the edges' first vertices, m.
        T_world_j: (e,) poses of the edges' second vertices, m.
        graph: the graph of the edges.

    Returns:
        The residuals, rotation (rad) before translation (m).
    """
    return _residual(_missed(between(T_world_i, T_world_j), T_world_j, graph), T_world_j, graph)


def edge_costs(poses: Poses, graph: PoseGraph) -> Float[Array, " e"]:
    """Return r' Omega r / 2 of each edge at the given poses."""
    r = residuals(picked(poses, graph.i), picked(poses, graph.j), graph)
    return jnp.einsum("ei,eij,ej->e", r, graph.information, r) / 2


def linearise(poses: Poses, graph: PoseGraph) -> Linearised:
    """Return cost, gradient and Gauss-Newton Hessian of each edge, in closed form.

    Perturbations change E = Z^-1 T_i^-1 T_j to E exp(d_j - Ad(T_j^-1 T_i) d_i), and Log(E exp(d)) changes by
    J_r^-1 d. So the derivative by d_i is that by d_j times -Ad. The point of a position with lever l moves by
    R_j (v + w x l) for d = (w, v).

    Args:
        poses: (n,) T_world_vertex, m, at which to linearise.
        graph: the graph of the edges.
    """
    T_world_i, T_world_j = computed_once((picked(poses, graph.i), picked(poses, graph.j)))
    r, A_j, across = _slopes(T_world_i, T_world_j, graph)
    weighted_j, weighted_r = computed_once(
        (_product(graph.information, A_j), jnp.einsum("eij,ej->ei", graph.information, r))
    )
    H_jj, g_j = computed_once((_product(_turned(A_j), weighted_j), jnp.einsum("eji,ej->ei", A_j, weighted_r)))
    H_ij = computed_once(-_product(_turned(across), H_jj))
    return Linearised(
        cost=jnp.sum(r * weighted_r, -1) / 2,
        H_ii=-_product(H_ij, across),
        H_ij=H_ij,
        H_jj=H_jj,
        g_i=-jnp.einsum("eji,ej->ei", across, g_j),
        g_j=g_j,
    )


def gradient(poses: Poses, graph: PoseGraph) -> Float[Array, "n d"]:
    """Return the gradient of the cost by right perturbations of the poses.

    Args:
        poses: (n,) T_world_vertex, m.
        graph: the graph of the edges.
    """
    r, A_j, across = _slopes(picked(poses, graph.i), picked(poses, graph.j), graph)
    g_j = jnp.einsum("eji,ejk,ek->ei", A_j, graph.information, r)
    g_i = -jnp.einsum("eji,ej->ei", across, g_j)
    return jnp.zeros((len(graph.fixed), g_j.shape[-1]), g_j.dtype).at[graph.i].add(g_i).at[graph.j].add(g_j)


def edge_hessians(poses: Poses, graph: PoseGraph) -> Float[Array, "e h h"]:
    """Return the second derivatives of each edge's cost by the steps of its first and second vertex.

    They contain the second derivatives of the residual, which :func:`linearise` leaves out. Let Phi be the
    Hessian by d_j. It is the symmetric part of the derivative of the gradient g_j at moved poses T exp(d_j).
    With a = -Ad(T_j^-1 T_i) d_i, both steps change E to E exp(a) exp(d_j) = E exp(a + d_j + [a, d_j] / 2) up
    to second order. So the other blocks follow from Phi, Ad and the bracket.

    Args:
        poses: (n,) T_world_vertex, m.
        graph: the graph of the edges.

    Returns:
        The Hessians, h = 2 d: the d rows of the first vertex, then those of the second one.
    """
    T_world_j = picked(poses, graph.j)
    r, A_j, across = _slopes(picked(poses, graph.i), T_world_j, graph)
    size = r.shape[-1]
    weighted_r = jnp.einsum("eij,ej->ei", graph.information, r)
    g_j = jnp.einsum("eji,ej->ei", A_j, weighted_r)

    def bend_along(direction: Float[Array, " d"]) -> Array:
        """Return the change of g_j by that of A_j."""
        step = jnp.broadcast_to(direction, r.shape)
        of_log = jax.jvp(right_jacobian_inverse, (r,), (A_j @ direction,))[1]
        of_position = jax.jvp(
            lambda step: _position_slope(moved(T_world_j, step), graph), (jnp.zeros_like(r),), (step,)
        )[1]
        change = jnp.where((graph.kind == POSITION)[:, None, None], of_position, of_log)
        return jnp.einsum("eji,ej->ei", change, weighted_r)

    identity = jnp.eye(size, dtype=r.dtype)
    bend = jax.vmap(bend_along, out_axes=-1)(identity)
    H_jj = _product(_turned(A_j), _product(graph.information, A_j)) + (bend + _turned(bend)) / 2
    bracket = jnp.einsum("ek,akb->eab", g_j, _ad(identity))
    H_ij = -_product(_turned(across), H_jj + bracket / 2)
    H_ii = _product(_turned(across), _product(H_jj, across))
    return jnp.block([[H_ii, H_ij], [_turned(H_ij), H_jj]])


def _slopes(T_world_i: Poses, T_world_j: Poses, graph: PoseGraph) -> tuple[Array, Array, Array]:
    """Return residuals, their derivatives A by the second vertex, and Ad; those by the first are -A Ad."""
    across = rotation_first(between(T_world_j, T_world_i).adjoint(), axes=2)
    across = computed_once(jnp.where(_is_unary(graph)[:, None, None], 0.0, across))
    r = computed_once(residuals(T_world_i, T_world_j, graph))
    A_j = right_jacobian_inverse(r)
    A_j = jnp.where((graph.kind == POSITION)[:, None, None], _position_slope(T_world_j, graph), A_j)
    return r, A_j, across


def right_jacobian_inverse(tangent: Float[Array, "e d"]) -> Float[Array, "e d d"]:
    """Return the derivative of Log(exp(tangent) exp(d)) at d = 0.

    J_r^-1 = I + ad / 2 + a ad^2 + b ad^4 with a = 2 / x^2 + (x + 3 sin x) / (4 x (cos x - 1)) and
    b = 1 / x^4 + (x + sin x) / (4 x^3 (cos x - 1)), where x is the angle (Bullo & Murray, "Proportional
    derivative (PD) control on the Euclidean group", 1995). In the plane ad^4 = -x^2 ad^2, and the formula
    holds as well.

    Args:
        tangent: rotation (rad) before translation (m), d = 6 in space and 3 in the plane.
    """
    rotation = tangent[:, :3] if tangent.shape[-1] == 6 else tangent[:, :1]
    squared = jnp.sum(rotation**2, -1)
    near = squared < _SERIES_BELOW**2
    x2 = jnp.where(near, 1.0, squared)
    x = jnp.sqrt(x2)
    less = 4 * (jnp.cos(x) - 1)
    a = 2 / x2 + (x + 3 * jnp.sin(x)) / (x * less)
    b = 1 / x2**2 + (x + jnp.sin(x)) / (x2 * x * less)
    s = squared
    a = jnp.where(near, 1 / 12 - s**2 * (1 / 30240 + s * (1 / 604800 + s / 15966720)), a)
    b = jnp.where(near, -1 / 720 - s * (1 / 15120 + s * (1 / 403200 + s / 11975040)), b)
    ad, a, b = computed_once((_ad(tangent), a, b))
    ad2 = computed_once(_product(ad, ad))
    ad4 = computed_once(_product(ad2, ad2))
    identity = jnp.eye(tangent.shape[-1], dtype=tangent.dtype)
    return identity + ad / 2 + a[:, None, None] * ad2 + b[:, None, None] * ad4


_NEAR_HALF_TANGENT = 0.02
"""Squared tangent of half the angle below which the rotation vector is computed by its series."""
_NEAR_ANGLE = 0.25
"""Squared angle, rad^2, below which the inverse of the left Jacobian is computed by its series."""
_ARCTANGENT = [(-1) ** n / (2 * n + 1) for n in range(12)]
"""Coefficients of atan(x) / x by powers of x^2."""
_COTANGENT = [float(2 * zeta(2 * n) / (2 * np.pi) ** (2 * n)) for n in range(1, 11)]
"""Coefficients of (1 - x/2 cot(x/2)) / x^2 by powers of x^2 (Abramowitz & Stegun, 4.3.70 and 23.2.16)."""


def logarithm(poses: Poses) -> Float[Array, "e d"]:
    """Return the logarithms of (e,) poses, rotation (rad) before translation (m).

    With the rotation vector w, the translation's part is J(w)^-1 t = t - w x t / 2 + k w x (w x t), where
    k = (1 - x/2 cot(x/2)) / x^2 and x = |w| (Barfoot, "State estimation for robotics", 2017, section 7.1).
    Values and the first three derivatives are accurate to rounding at small angles and at zero. Those of
    jaxlie's logarithms are not: near an angle of 3e-5 rad, second derivatives in the plane have no correct
    digit, and third derivatives in space are off by a tenth.

    Args:
        poses: (e,) poses, m; a rotation by half a turn has no unique logarithm.
    """
    (numbers,) = jax.tree.leaves(poses)
    if poses.tangent_dim == 6:
        turn, shift = _rotation_vector(numbers[:, :4]), numbers[:, 4:]
        cross = skew(turn)
        swept = jnp.sum(cross * shift[:, None, :], -1)
        swept_twice = jnp.sum(cross * swept[:, None, :], -1)
    else:
        turn, shift = jnp.arctan2(numbers[:, 1], numbers[:, 0])[:, None], numbers[:, 2:]
        swept = turn * jnp.stack([-shift[:, 1], shift[:, 0]], -1)
        swept_twice = -(turn**2) * shift
    squared = jnp.sum(turn**2, -1)
    near = squared < _NEAR_ANGLE
    half = jnp.sqrt(jnp.where(near, 1.0, squared)) / 2
    k = (1 - half * jnp.cos(half) / jnp.sin(half)) / (4 * half**2)
    k = jnp.where(near, _series(jnp.where(near, squared, 0.0), _COTANGENT), k)
    return jnp.concatenate([turn, shift - swept / 2 + k[:, None] * swept_twice], -1)


def _rotation_vector(wxyz: Float[Array, "e 4"]) -> Float[Array, "e 3"]:
    """Return the rotation vectors, at most half a turn, of quaternions of any length above zero."""
    w, v = wxyz[:, 0], wxyz[:, 1:]
    squared = jnp.sum(v**2, -1)
    near = squared < _NEAR_HALF_TANGENT * w**2
    safe_w, length = jnp.where(near, w, 1.0), jnp.sqrt(jnp.where(near, 1.0, squared))
    # q and -q are the same rotation
    sign = jnp.where(w < 0, -1.0, 1.0)
    factor = 2 * sign * jnp.arctan2(length, sign * w) / length
    series = 2 / safe_w * _series(jnp.where(near, squared / safe_w**2, 0.0), _ARCTANGENT)
    return jnp.where(near, series, factor)[:, None] * v


def _series(x: Float[Array, " e"], coefficients: Sequence[float]) -> Float[Array, " e"]:
    """Return the sum of coefficient n times x^n."""
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def _missed(T_i_j: Poses, T_world_j: Poses, graph: PoseGraph) -> Poses:
    """Return the error Z^-1 T_i_j of an edge between two vertices, Z^-1 T_world_j of one on one vertex."""
    alone = _is_unary(graph)[:, None]
    T_i_j = jax.tree.map(lambda single, both: jnp.where(alone, single, both), T_world_j, T_i_j)
    return between(graph.measurement, T_i_j)


def _residual(missed: Poses, T_world_j: Poses, graph: PoseGraph) -> Float[Array, "e d"]:
    point = T_world_j.translation()
    if graph.lever is not None:
        point = point + _rotated(T_world_j, graph.lever)
    off = point - graph.measurement.translation()
    rotates = missed.tangent_dim - off.shape[-1]
    position = jnp.pad(off, ((0, 0), (rotates, 0)))
    return jnp.where((graph.kind == POSITION)[:, None], position, logarithm(missed))


def _position_slope(T_world_j: Poses, graph: PoseGraph) -> Float[Array, "e d d"]:
    """Return the derivative of (0, T_j exp(d) l - z) at d = 0."""
    R = T_world_j.rotation().as_matrix()
    size, dimensions = T_world_j.tangent_dim, R.shape[-1]
    by_shift = jnp.pad(R, ((0, 0), (size - dimensions, 0), (size - dimensions, 0)))
    if graph.lever is None:
        return by_shift
    if dimensions == 3:
        swept = -_product(R, skew(graph.lever))
    else:
        swept = _rotated(T_world_j, jnp.stack([-graph.lever[:, 1], graph.lever[:, 0]], -1))[:, :, None]
    return by_shift + jnp.pad(swept, ((0, 0), (size - dimensions, 0), (0, dimensions)))


def _rotated(poses: Poses, vectors: Float[Array, "e k"]) -> Float[Array, "e k"]:
    return jnp.sum(poses.rotation().as_matrix() * vectors[:, None, :], -1)


def _is_unary(graph: PoseGraph) -> Array:
    return graph.kind >= PRIOR


def _ad(tangent: Float[Array, "e d"]) -> Float[Array, "e d d"]:
    """Return the matrix whose product with another tangent is the Lie bracket of both."""
    if tangent.shape[-1] == 6:
        turn, shift = skew(tangent[:, :3]), skew(tangent[:, 3:])
        none = jnp.zeros_like(turn)
        return jnp.block([[turn, none], [shift, turn]])
    angle, x, y = tangent.T
    none = jnp.zeros_like(angle)
    return jnp.stack(
        [
            jnp.stack([none, none, none], -1),
            jnp.stack([y, none, -angle], -1),
            jnp.stack([-x, angle, none], -1),
        ],
        -2,
    )


def _product(left: Float[Array, "e d d"], right: Float[Array, "e d d"]) -> Float[Array, "e d d"]:
    """Return products of small matrices in one vectorised loop; XLA's own product makes a call for each."""
    terms = [left[..., :, k, None] * right[..., None, k, :] for k in range(left.shape[-1])]
    return sum(terms[1:], terms[0])


def _turned(matrix: Float[Array, "e d d"]) -> Float[Array, "e d d"]:
    return jnp.swapaxes(matrix, -1, -2)
