"""Take the back end's corrections into the running odometry.

A recipe that matches scans with keyframes can go on from their corrected poses: its state then lies in the
frame *map*, which moves with each correction, and a place that is met again has its old map. What a run hands
to its sinks lies in the frame *odom*, in which nothing ever jumps: this is the odometry that the back end
corrects, so that no correction counts twice. ``T_map_odom`` relates the two frames, as LIO-SAM's
TransformFusion does.

``T_map_odom`` is a translation and a rotation about the vertical, because the inertial samples observe the
tilt of the vehicle: its latest keyframe lies in *map* where the back end puts it, with the corrected heading
and the odometry's own tilt. The other keyframes lie in *map* as the back end places them relative to it.

A correction is applied a fixed number of keyframes after the one that it follows from, so that a run does not
depend on the speed of the back end's thread.
"""

from bisect import bisect_right
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.xla import programs
from lio_jax.loops.back_end import Correction, corrected_poses, levelled_onto
from lio_jax.recipes.recipe import CorrectingRecipe, Output
from lio_jax.run.paging import KeyframePager, Pager

DELAY = 5
"""Number of keyframes of the back end from the one that a correction follows from to its application. The run
waits for the back end if it takes longer."""
_TAKEN = 2
"""The sinks have taken the results up to this number of scans before the next one, see
:func:`lio_jax.run.track.track`."""

_Nav = TypeVar("_Nav")


class Feedback:
    """The corrections of a run, and the frames before and after them."""

    def __init__(self, recipe: CorrectingRecipe, params: Any) -> None:
        """Begin without keyframes.

        Args:
            recipe: of the run.
            params: of its steps.
        """
        self._params = params
        self._program = programs(type(recipe).corrected, recipe, donate=(1,))
        self._correction_after: Callable[[int], Correction | None] = lambda _: None
        self._scans: list[int] = []
        """The scan of each keyframe of the back end."""
        self._asked = -1
        """The last keyframe of the back end whose correction was asked for."""
        self._T_map_odom = np.eye(4)
        self._stamps_ns: list[int] = []
        self._T_odom_lidar: list[NDArray[np.float64]] = []
        """(4, 4) pose of each keyframe of the recipe, m, by its running number."""
        self._rows = np.zeros(0, np.int32)
        """Running numbers of the keyframes in the recipe's rows."""

    def follow(self, correction_after: Callable[[int], Correction | None]) -> None:
        """Take corrections from a back end.

        Args:
            correction_after: returns the correction after a keyframe, or None without a new one.
        """
        self._correction_after = correction_after

    def add_keyframe(self, scan: int) -> None:
        """Take note that a scan is the next keyframe of the back end."""
        self._scans.append(scan)

    def take(self, stamp_ns: int, output: Output) -> None:
        """Take the output of the next scan, in the frame *map*."""
        table = output.keyframes
        assert table is not None
        self._rows = np.asarray(table.numbers)
        if int(table.added) >= 0:
            T_map_lidar = np.asarray(output.registration.T_world_lidar.as_matrix())
            self._stamps_ns.append(stamp_ns)
            self._T_odom_lidar.append(np.linalg.inv(self._T_map_odom) @ T_map_lidar)

    def applied(self, state: Any, scan: int, pager: Pager | None) -> Any:
        """Return the state before a scan, corrected if a correction is due.

        Args:
            state: of the recipe; it is consumed. None: it has the correction already, and only the frames
                and the pager follow.
            scan: number of the scan among the tracked ones.
            pager: its keyframes move, too.
        """
        found = self._due(scan)
        if found is None:
            return state
        last, before = found.T_odom_imu[-1], self._T_map_odom
        self._T_map_odom = levelled_onto(last, found.T_world_imu[-1])
        T_map_world = self._T_map_odom @ last @ np.linalg.inv(found.T_world_imu[-1])
        stamps, T_odom_lidar = np.array(self._stamps_ns, np.int64), np.array(self._T_odom_lidar)
        placed = corrected_poses(stamps, T_odom_lidar, found.stamp_ns, found.T_odom_imu, found.T_world_imu)
        poses = np.asarray(jaxlie.SE3.from_matrix(jnp.asarray(T_map_world @ placed)).wxyz_xyz)
        T_new_old = jaxlie.SE3.from_matrix(jnp.asarray(self._T_map_odom @ np.linalg.inv(before)))
        if isinstance(pager, KeyframePager):
            pager.moved(T_new_old, poses)
        # free rows take any pose
        rows = jaxlie.SE3(jnp.asarray(poses[self._rows]))
        return None if state is None else self._program(self._params, state, T_new_old, rows)

    def in_odometry(self, nav: _Nav, output: Output) -> tuple[NDArray[np.float64], _Nav, Output]:
        """Return ``T_map_odom``, (4, 4) m, and the result of the last scan in the frame *odom*.

        Args:
            nav: after the scan, in the frame *map*.
            output: likewise; the leaves that change become numpy arrays.
        """
        if np.array_equal(self._T_map_odom, np.eye(4)):
            return self._T_map_odom, nav, output
        T_odom_map = jaxlie.SE3.from_matrix(jnp.asarray(np.linalg.inv(self._T_map_odom)))
        moved = _in_frame(T_odom_map, _places(nav, output))
        both = eqx.tree_at(lambda both: _places(*both), (nav, output), jax.tree.map(np.array, moved))
        return self._T_map_odom, *both

    def _due(self, scan: int) -> Correction | None:
        """Return the correction to be applied before a scan, if there is a new one."""
        index = bisect_right(self._scans, scan - _TAKEN) - 1 - DELAY
        if index <= self._asked:
            return None
        self._asked = index
        return self._correction_after(index)


def _places(nav: Any, output: Output) -> tuple[Any, ...]:
    """Return what differs between two frames with the same vertical."""
    T_world_lidar = output.registration.T_world_lidar
    return nav.T_world_imu, nav.velocity, nav.gravity, T_world_lidar, output.origin, output.points


@jax.jit
def _in_frame(T_new_old: jaxlie.SE3, places: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return :func:`_places` in another frame; points are turned only: they count from the origin."""
    T_world_imu, velocity, gravity, T_world_lidar, origin, points = places
    turn = rotation_matrix(T_new_old.rotation())
    return (
        T_new_old @ T_world_imu,
        turn @ velocity,
        turn @ gravity,
        T_new_old @ T_world_lidar,
        T_new_old @ origin,
        points @ turn.T.astype(points.dtype),
    )
