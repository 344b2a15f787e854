"""The motions that several test files look at, and their states by programs that compile once."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.trajectory import RouteMotion, kinematics_at, motion_along, motion_through, pose_at
from tests.sim.routes import FLIGHT, LAP, WALK

DURATION = 60.0


@cache
def motion_of(name):
    """Return "car", "handheld" and "drone" along routes, or "spline" through poses of the second."""
    if name == "car":
        return motion_along(LAP, duration_s=DURATION, standstill_s=1.5, seed=1)
    if name == "handheld":
        return motion_along(WALK, duration_s=DURATION, standstill_s=1.0, seed=2)
    if name == "drone":
        return motion_along(FLIGHT, duration_s=DURATION, seed=3)
    times = np.cumsum(np.random.default_rng(0).uniform(0.03, 0.07, 200))
    return motion_through(Trajectory((times * 1e9).astype(np.int64), poses_at(motion_of("handheld"), times)))


_compiled_poses = eqx.filter_jit(jax.vmap(lambda motion, t: pose_at(motion, t).as_matrix(), (None, 0)))
_compiled_kinematics = eqx.filter_jit(jax.vmap(kinematics_at, (None, 0)))


def states_at(motion, times):
    """Return the states at up to 4000 instants, always by the same program."""
    states = _compiled_kinematics(motion, jnp.asarray(np.resize(times, 4000)))
    return jax.tree.map(lambda leaf: np.array(leaf[: len(times)]), states)


def poses_at(motion, times):
    """Return (n, 4, 4) T_world_imu at up to 3001 instants, always by the same program."""
    return np.asarray(_compiled_poses(motion, jnp.asarray(np.resize(times, 3001)))[: len(times)])


def way_time(motion: RouteMotion) -> float:
    """Return how long an open route takes one way, s."""
    return (motion.control.shape[0] - 6) / float(motion.knot_rate) + float(motion.pull_away)


def without_sway(motion: RouteMotion) -> RouteMotion:
    """Return the same motion without sway."""
    return eqx.tree_at(lambda m: m.sway.amplitude, motion, 0 * motion.sway.amplitude)
