"""A recipe in a file of one's own: an iterated filter on the planes of a voxel map.

scan -> thin -> deskew -> iterated update (match, linearise) -> insert -> map
imu  -> propagate --/------------/

lio-jax run DATA --recipe experiments/own_recipe.py:OwnRecipe --out out/own
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

from lio_jax import InertialConfig, InertialParams, Needs, Output, Recipe, State, section, static
from lio_jax.core.error_state import NavEstimate
from lio_jax.core.types import ITERATION_LIMIT, ImuBatch, NavState, Scan
from lio_jax.imu.path import deskew_along
from lio_jax.lidar.params import BeamParams, ScanConfig
from lio_jax.lidar.thinning import thinned
from lio_jax.mapping.params import VoxelMapParams
from lio_jax.mapping.voxel_map import VoxelMap, empty_map, insert
from lio_jax.recipes import inertial_filter as inertial
from lio_jax.registration.params import RobustFilterMatch, ThinnedMatch
from lio_jax.registration.scan_match import FixedPoints
from lio_jax.registration.voxel_planes import ScanToVoxels


class Match(RobustFilterMatch, ThinnedMatch):
    """A robust match of the thinned scan in the filter."""


class Params(InertialParams):
    """Traced parameters, with defaults that differ from those of the sections."""

    lidar: BeamParams = section(BeamParams)
    map: VoxelMapParams = section(VoxelMapParams, voxel_size=1.0)
    registration: Match = section(Match, point_spacing=0.6, kernel=0.2)


@dataclass(frozen=True)
class Sizes(ScanConfig):
    """Capacity of the thinned scan."""

    points: int = static(4096, above=0)
    """Capacity of the points that are matched and written into the map."""


@dataclass(frozen=True)
class Config(InertialConfig):
    """Static settings."""

    lidar: Sizes = section(Sizes)


class Carried(State):
    """What is carried from scan to scan."""

    nav: NavState
    covariance: Float[Array, "24 24"]
    scans: Int32[Array, ""]
    map: VoxelMap

    def with_velocity_of(self, found: "Carried") -> "Carried":
        return eqx.tree_at(lambda state: state.nav.velocity, self, found.nav.velocity)


class OwnRecipe(Recipe[Config, Params, Carried]):
    """One spacing of points for match and map, and a wide kernel that opens by a fixed amount."""

    config_type, params_type, needs = Config, Params, Needs(imu="required")

    def init(self, params: Params, imu: ImuBatch | None = None) -> Carried:
        start = inertial.levelled_start(params, imu)
        return Carried(start.nav, start.covariance, jnp.int32(0), empty_map(self.config.map.capacity))

    def step(self, params: Params, state: Carried, scan: Scan, imu: ImuBatch | None = None):
        first, sizes, spacing = state.scans == 0, self.config.lidar.points, params.registration.point_spacing
        thin = thinned(params.lidar, scan, params.map.point_spacing, spacing, sizes, sizes)
        prior, path = inertial.predicted(params, NavEstimate(state.nav, state.covariance), scan, imu, first)
        points = deskew_along(path, prior.nav.T_imu_lidar, thin.points, thin.time)
        to_match, opening = FixedPoints(points[thin.matched.index]), jnp.where(state.scans < 3, 2.0, 0.2)
        match = ScanToVoxels(to_match, inertial.lidar_pose(prior.nav), params.registration, state.map,
                             thin.matched.mask, opening, params.map, params.lidar)  # fmt: skip
        update, matched = inertial.corrected(prior, match, self.config.registration.max_iterations)
        nav, lost, frame = update.state.nav, (update.status > ITERATION_LIMIT) & ~first, match.frame()
        _, placed = jax.lax.stop_gradient(frame.place(points, inertial.lidar_pose(matched)))
        reach = params.map.voxel_size.astype(jnp.float32), params.map.reach.astype(jnp.float32)
        vmap, added = insert(state.map, placed, thin.mask & ~lost, frame.anchor, *reach)
        found, innovation = inertial.registration_of(update, inertial.lidar_pose(nav)), update.innovation
        return Carried(nav, update.state.covariance, state.scans + jnp.any(thin.mask), vmap), Output(
            found, lost, innovation.nis, innovation.dof, placed, thin.mask, added.added, frame.origin,
            thin.dropped, added.dropped, covariance=update.state.covariance,
            evidence=inertial.evidence_of(update, prior))  # fmt: skip
