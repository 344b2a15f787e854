"""FAST-LIO2: an iterated error-state filter on planes through the nearest points of an incremental map.

scan -> every n-th -> deskew -> voxel mean -> iterated update (5-nn planes) -> insert -> cube of points
imu  -> propagate ----/----------------------/

Xu, Cai, He, Lin & Zhang, "FAST-LIO2: Fast direct LiDAR-inertial odometry", T-RO 2022. Its values are those of
``recipe_settings("fast_lio2")``. Without inertial samples the velocity is taken as constant.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.config import Config
from lio_jax.core.error_state import NavEstimate
from lio_jax.core.params import Params
from lio_jax.core.status import ITERATION_LIMIT
from lio_jax.core.types import ImuBatch, NavState, Scan
from lio_jax.imu.path import deskew_along
from lio_jax.lidar.thinning import mean_per_voxel
from lio_jax.mapping.point_map import EDGE, PointMap, empty_map, insert, move_cube
from lio_jax.recipes import recipe
from lio_jax.recipes.constant_velocity import (
    carried_on,
    mean_rate,
    predicted_without_samples,
    unlevelled_start,
    until_its_middle,
)
from lio_jax.recipes.inertial_filter import levelled_start, lidar_pose, predicted
from lio_jax.recipes.output import Output
from lio_jax.recipes.recipe import Needs, Recipe
from lio_jax.recipes.scan_update import corrected, evidence_of, registration_of
from lio_jax.registration.knn_planes import ScanToPoints
from lio_jax.registration.scan_match import FixedPoints


class State(recipe.State):
    """What is carried from scan to scan."""

    nav: NavState
    """At the last scan's end."""
    uncertain: NavEstimate
    """What the filter estimates: the navigation state at the last scan's end, and its covariance. Without
    inertial samples that at the scan's middle, where an error of the velocity distorts the scan least."""
    rate: Float[Array, "3"]
    """Mean angular rate between the last two of those instants, rad/s, IMU frame."""
    to_end: Float[Array, ""]
    """From that instant to the scan's end, s."""
    scans: Int32[Array, ""]
    """Scans with points seen so far."""
    map: PointMap

    def with_velocity_of(self, found: "State") -> "State":
        """Return this first state with the velocity of a later one, and with its angular rate."""

        def motion(state: Any) -> tuple[Any, ...]:
            return state.nav.velocity, state.uncertain.nav.velocity, state.rate

        return eqx.tree_at(motion, self, motion(found))


class FastLio2(Recipe[Config, Params, State]):
    """FAST-LIO2."""

    needs = Needs()

    def init(self, params: Params, imu: ImuBatch | None = None) -> State:
        """Return the state before the first scan: at the world's origin.

        Args:
            params: traced.
            imu: samples of about a second up to the first scan's end; None: there are no inertial data.
        """
        config = self.config
        start = unlevelled_start(params) if imu is None else levelled_start(params, imu)
        none = jnp.zeros_like(start.nav.velocity)
        return State(
            nav=start.nav,
            uncertain=start,
            rate=none,
            to_end=none[0],
            scans=jnp.int32(0),
            map=empty_map(config.map.capacity),
        )

    def step(
        self, params: Params, state: State, scan: Scan, imu: ImuBatch | None = None
    ) -> tuple[State, Output]:
        """Predict by the inertial samples, correct by the scan, add the scan to the map.

        Args:
            params: traced.
            state: donate it.
            scan: padded sweep; ``scan.interval`` is the time since the last scan's end.
            imu: samples around that time.
        """
        config = self.config
        first = state.scans == 0
        voxel_size = params.map.voxel_size.astype(jnp.float32)
        with jax.named_scope("predict"):
            if imu is None:
                to_end = scan.duration.astype(state.to_end.dtype) / 2
                scan = until_its_middle(scan, state.to_end)
                prior, path = predicted_without_samples(params, state.uncertain, state.rate, scan, first)
            else:
                to_end = jnp.zeros_like(state.to_end)
                # as FAST-LIO2 does, the match is taken for one of the pose at the scan's end
                prior, path = predicted(params, state.uncertain, scan, imu, first, sweep_start=scan.duration)
            T_predicted = lidar_pose(prior.nav)
        with jax.named_scope("thin"):
            points, time, in_range = _filtered(config.fast_lio2.point_filter_num, params, scan)
            points = deskew_along(path, prior.nav.T_imu_lidar, points, time)
            spacing = params.registration.point_spacing.astype(jnp.float32)
            thin = mean_per_voxel(points, in_range, spacing, config.lidar.registration_points)
        with jax.named_scope("update"):
            match = ScanToPoints(
                points_at=FixedPoints(thin.points),
                T_predicted=T_predicted,
                registration=params.registration,
                map=state.map,
                mask=thin.mask,
                map_params=params.map,
                knn=params.knn,
                lidar=params.lidar,
                neighbours=config.knn.neighbours,
            )
            frame = match.frame()
            update, _ = corrected(prior, match, config.registration.max_iterations)
            posterior: NavEstimate = update.state
            lost = (update.status > ITERATION_LIMIT) & ~first
            T_world_lidar = lidar_pose(posterior.nav)
        with jax.named_scope("insert"):
            # the map is a constant of the derivative
            _, placed = jax.lax.stop_gradient(frame.place(thin.points, T_world_lidar))
            side = params.point_map.cube_side_length
            margin = params.point_map.cube_margin * params.lidar.max_range
            in_blocks = jnp.stack([side / 2, margin]).astype(jnp.float32) / (EDGE * voxel_size)
            cube_map, added = insert(
                state.map,
                placed,
                thin.mask & ~lost,
                frame.anchor,
                voxel_size,
                in_blocks[0],
                params.point_map.nearer_by.astype(jnp.float32),
            )
            # last, because whatever still reads the map beside it would make XLA copy the map
            cube_map = move_cube(cube_map, frame.anchor, *in_blocks)

        seen = jnp.any(thin.mask)
        rate = jnp.where(first | lost, state.rate, mean_rate(state.uncertain.nav, posterior.nav, scan))
        new_state = State(
            nav=carried_on(posterior.nav, rate, to_end) if imu is None else posterior.nav,
            uncertain=posterior,
            rate=rate,
            to_end=to_end,
            scans=state.scans + seen.astype(jnp.int32),
            map=cube_map,
        )
        return new_state, Output(
            registration=registration_of(update, T_world_lidar),
            lost=lost,
            nis=update.innovation.nis,
            nis_dof=update.innovation.dof,
            points=placed,
            points_mask=thin.mask,
            added=added.added,
            origin=frame.origin,
            thinned_away=thin.dropped,
            map_dropped=added.dropped,
            covariance=posterior.covariance,
            evidence=evidence_of(update, prior),
        )


def _filtered(
    every: int, params: Params, scan: Scan
) -> tuple[Float[Array, "n 3"], Float[Array, " n"], Bool[Array, " n"]]:
    """Return every n-th point, its time, and whether it lies between the blind radius and the far limit."""
    points, time = scan.points[::every], scan.time[::every]
    squared_range = jnp.sum(points**2, -1)
    near, far = params.lidar.min_range.astype(jnp.float32), params.lidar.max_range.astype(jnp.float32)
    mask = scan.mask[::every] & (squared_range > near**2) & (squared_range < far**2)
    return jnp.where(mask[:, None], points, 0.0), time, mask
