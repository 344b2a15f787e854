"""The motion between two filter states at every instant, for deskewing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.imu.rotation_integrals import SERIES_LIMIT, rotation_series


class Path(eqx.Module):
    """Poses at k knots; between them the rate and the specific force in the IMU frame are constant.

    Before the first and after the last knot the nearest interval's goes on.
    """

    time: Float[Array, " k"]
    """Not descending, s from the scan's start."""
    T_world_imu: jaxlie.SE3
    """Pose at each knot; after :func:`relative_path` the world is another frame."""
    velocity: Float[Array, "k 3"]
    """In world, m/s."""
    rate: Float[Array, "n 3"]
    """Angular rate in each of the k - 1 intervals, bias removed, rad/s, IMU frame."""
    accel: Float[Array, "n 3"]
    """Specific force in each of the k - 1 intervals, bias removed, m/s^2, IMU frame."""
    gravity: Float[Array, "3"]
    """In world, m/s^2; zero where nothing was measured and the velocity is constant."""


def pose_at(path: Path, time: Float[Array, " n"]) -> jaxlie.SE3:
    """Return T_world_imu at n instants, exact for the path's constant inputs.

    Args:
        path: k knots; its dtype is the result's.
        time: s from the scan's start.
    """
    piece = _piece_at(path, time)
    zero = jnp.zeros_like(time, path.time.dtype)
    position = _carried(piece, (zero, zero, zero), path.gravity)
    rotation = jaxlie.SO3.from_matrix(jnp.stack(piece.rotation, axis=1).reshape(-1, 3, 3))
    turn = jaxlie.SO3.exp(jnp.stack(piece.turn, axis=1))
    return jaxlie.SE3.from_rotation_and_translation((rotation @ turn).normalize(), position)


def carry(path: Path, time: Float[Array, " n"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return ``pose_at(path, time) @ points`` without a pose per point.

    Args:
        path: k knots.
        time: s from the scan's start.
        points: m, each in the IMU frame of its own time.
    """
    piece = _piece_at(path, time)
    x, y, z = points.T
    return _carried(piece, (x, y, z), path.gravity)


def relative_path(path: Path, T_world_ref: jaxlie.SE3) -> Path:
    """Return the path with the frame ``ref`` in place of the world, so that float32 holds it precisely."""
    T_ref_world = T_world_ref.inverse()
    back = T_ref_world.rotation()
    return Path(
        time=path.time,
        T_world_imu=T_ref_world @ path.T_world_imu,
        velocity=back @ path.velocity,
        rate=path.rate,
        accel=path.accel,
        gravity=back @ path.gravity,
    )


def deskew_along(
    path: Path, T_imu_lidar: jaxlie.SE3, points: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Express points in the lidar frame of the path's last knot, in the points' dtype.

    Args:
        path: reaches from before the first point to the scan's end.
        T_imu_lidar: pose of the lidar in the IMU frame.
        points: m, lidar frame at each point's own firing time.
        time: firing time from the scan's start, s.
    """
    last = jaxlie.SE3(path.T_world_imu.wxyz_xyz[-1])
    # the last lidar frame in place of the world: the arithmetic in float32 stays near the origin
    near = jax.tree.map(lambda x: x.astype(points.dtype), relative_path(path, last @ T_imu_lidar))
    extrinsic = T_imu_lidar.as_matrix().astype(points.dtype)
    return carry(near, time, points @ extrinsic[:3, :3].T + extrinsic[:3, 3])


_Triple = tuple[Array, Array, Array]
"""The three components of n vectors: apart, because XLA's loops over (n, 3) compute each of them thrice."""


class _Piece(eqx.Module):
    """What n instants need of their interval."""

    rotation: tuple[Array, ...]
    """IMU frame at the interval's start to world, row by row."""
    position: _Triple
    """At the interval's start, m, world."""
    velocity: _Triple
    """At the interval's start, m/s, world."""
    turn: _Triple
    """Turned since the interval's start, rad, IMU frame."""
    force: _Triple
    """Specific force, m/s^2, IMU frame."""
    delay: Float[Array, " n"]
    """Since the interval's start, s."""


def _piece_at(path: Path, time: Float[Array, " n"]) -> _Piece:
    rotation = path.T_world_imu.rotation().as_matrix().reshape(-1, 9)
    columns = (path.time[:, None], rotation, path.T_world_imu.translation(), path.velocity)
    # one gather of whole rows, from a table that is written once instead of joined anew for every element
    table = jnp.zeros((len(path.rate), 22), path.time.dtype)
    first = 0
    for part in (*(column[:-1] for column in columns), path.rate, path.accel):
        table = table.at[:, first : first + part.shape[1]].set(part)
        first += part.shape[1]
    rows = table[jnp.sum(path.time[1:-1] <= time[:, None], axis=1)]
    start, *values = (rows[:, i] for i in range(22))
    delay = time.astype(start.dtype) - start
    x, y, z = (delay * rate for rate in values[15:18])
    return _Piece(
        tuple(values[:9]),
        _triple(values[9:12]),
        _triple(values[12:15]),
        (x, y, z),
        _triple(values[18:]),
        delay,
    )


def _triple(values: list[Array]) -> _Triple:
    x, y, z = values
    return x, y, z


def _carried(piece: _Piece, points: _Triple, gravity: Float[Array, "3"]) -> Float[Array, "n 3"]:
    """Return the points in world, by Exp(w) p = p + a w x p + b w x (w x p) and its second integral."""
    a, b, c, d = rotation_series(jnp.minimum(sum(x**2 for x in piece.turn), SERIES_LIMIT))
    turned, twice = _cross_twice(piece.turn, points)
    pushed, pushed_twice = _cross_twice(piece.turn, piece.force)
    h = piece.delay
    local = [
        points[i]
        + a * turned[i]
        + b * twice[i]
        + h**2 * (piece.force[i] / 2 + c * pushed[i] + d * pushed_twice[i])
        for i in range(3)
    ]
    carried = jnp.zeros((len(h), 3), h.dtype)
    for i in range(3):
        fallen = piece.position[i] + h * (piece.velocity[i] + h / 2 * gravity[i])
        # written column by column: stacked columns are computed anew for every element
        carried = carried.at[:, i].set(fallen + sum(piece.rotation[3 * i + j] * local[j] for j in range(3)))
    return carried


def _cross_twice(w: _Triple, p: _Triple) -> tuple[_Triple, _Triple]:
    once = _cross(w, p)
    return once, _cross(w, once)


def _cross(u: _Triple, v: _Triple) -> _Triple:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
