"""The default recipe: tightly coupled with inertial data, LiDAR odometry where there is none."""

from typing import Any

import equinox as eqx

from lio_jax.core.config import Config
from lio_jax.core.params import Params
from lio_jax.core.types import ImuBatch, Scan
from lio_jax.recipes import lidar_inertial, lidar_odometry
from lio_jax.recipes.output import Output

State = lidar_inertial.State | lidar_odometry.State


def init(config: Config, params: Params, imu: ImuBatch | None = None) -> State:
    """Return the state before the first scan.

    Args:
        config: static.
        params: traced.
        imu: samples of about a second up to the first scan's end; None: there are no inertial data.
    """
    if imu is None:
        return lidar_odometry.init(config, params)
    return lidar_inertial.init(config, params, imu)


def with_velocity_of(fresh: State, found: State) -> State:
    """Return the state before the first scan with the velocity of another: a mere exchange of leaves."""
    return eqx.tree_at(_velocity, fresh, _velocity(found))


def _velocity(state: State) -> Any:
    return state.twist if isinstance(state, lidar_odometry.State) else state.uncertain.nav.velocity


def step(
    config: Config, params: Params, state: State, scan: Scan, imu: ImuBatch | None = None
) -> tuple[State, Output]:
    """Estimate one scan's pose and add the scan to the map.

    Args:
        config: static.
        params: traced.
        state: of the form that ``init`` chose; donate it.
        scan: padded sweep.
        imu: samples around the time since the last scan's end.
    """
    if isinstance(state, lidar_odometry.State):
        return lidar_odometry.step(config, params, state, scan)
    assert imu is not None
    return lidar_inertial.step(config, params, state, scan, imu)
