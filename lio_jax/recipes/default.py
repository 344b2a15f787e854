"""The default recipe: tightly coupled with inertial samples, LiDAR odometry where there are none."""

from lio_jax.core.config import Config
from lio_jax.core.params import Params
from lio_jax.core.types import ImuBatch, Scan
from lio_jax.recipes import lidar_inertial, lidar_odometry
from lio_jax.recipes.output import Output
from lio_jax.recipes.recipe import Recipe

State = lidar_inertial.State | lidar_odometry.State


class Default(Recipe[Config, Params, State]):
    """The project's own recipe: Gauss-Newton or an iterated filter on the planes of a voxel map."""

    def init(self, params: Params, imu: ImuBatch | None = None) -> State:
        """Return the state before the first scan; its form depends on whether there are inertial samples."""
        if imu is None:
            return lidar_odometry.init(self.config, params)
        return lidar_inertial.init(self.config, params, imu)

    def step(
        self, params: Params, state: State, scan: Scan, imu: ImuBatch | None = None
    ) -> tuple[State, Output]:
        """Estimate one scan's pose and add the scan to the map."""
        if isinstance(state, lidar_odometry.State):
            return lidar_odometry.step(self.config, params, state, scan)
        assert imu is not None
        return lidar_inertial.step(self.config, params, state, scan, imu)
