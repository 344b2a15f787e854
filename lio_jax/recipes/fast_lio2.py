"""FAST-LIO2: an iterated error-state filter on planes through the nearest points of an incremental map.

scan -> every n-th -> deskew -> voxel mean -> iterated update (5-nn planes) -> insert -> cube of points
imu  -> propagate ----/----------------------/

Xu, Cai, He, Lin & Zhang, "FAST-LIO2: Fast direct LiDAR-inertial odometry", T-RO 2022. Its values are those of
``recipe_settings("fast_lio2")``. Without inertial samples the velocity is taken as constant.

What differs from FAST-LIO2's program on purpose:

- The world is level at the start. There the first pose of the IMU is the world, and gravity leans in it.
- At the start the difference between the mean specific force and gravity is the accelerometer's bias. There
  all samples are scaled by gravity over the mean. A vehicle that moves is recognised, and its biases stay
  zero. Samples in g are recognised by the reader.
- A scan has up to 8 updates (there 4). Neighbours are searched anew once the points have moved by more than
  ``params.registration.reassociation_distance``; there at the first update, and again when the step is small.
- Five neighbours that lie on a line define no plane (``params.knn.least_width``).
- A point replaces the one in its voxel if it is nearer to the centre by more than
  ``params.point_map.nearer_by``; there by any distance.
- The covariance contains the map's error, unless ``config.fast_lio2.exact_map`` is true.
- A scan with fewer than ``params.registration.min_matches`` matches is lost: its pose is the prediction, and
  after a long outage a new piece of map begins with it. There one match is enough.
- Clocks that differ by more than a second are aligned by the reader of bags, for any sensor
  (``config.data.align_clocks``); there by the receiver of Livox messages. Smaller lags may be a state.
- ``config.output.clouds`` writes the points that ``config.fast_lio2.point_filter_num`` leaves out, too.
- Features of the raw scan (``feature_extract_enable``) are not offered.

There is no rule for degenerate directions, as there: the prediction's covariance decides, and only a
direction without any information is left out.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.error_state import NavEstimate
from lio_jax.core.leaf import section, static
from lio_jax.core.types import ITERATION_LIMIT, ImuBatch, NavState, Scan
from lio_jax.estimation.map_drift import MapDrift
from lio_jax.imu.params import ImuParams, InitialParams
from lio_jax.imu.path import deskew_along
from lio_jax.lidar.params import LidarParams, ScanConfig
from lio_jax.lidar.thinning import mean_per_voxel
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.params import MapConfig, MapParams, MovingCubeParams
from lio_jax.mapping.point_map import EDGE, PointMap, empty_map, following, insert, move_cube
from lio_jax.mapping.voxel_map import anchor_of
from lio_jax.recipes import recipe
from lio_jax.recipes.constant_velocity import (
    carried_on,
    mean_rate,
    predicted_without_samples,
    unlevelled_start,
    until_its_middle,
    with_gravity_held,
)
from lio_jax.recipes.inertial_filter import (
    after_match,
    corrected,
    evidence_of,
    levelled_start,
    lidar_pose,
    planes_met,
    predicted,
    registration_of,
)
from lio_jax.recipes.params import InertialConfig, InertialParams
from lio_jax.recipes.recipe import Needs, Outage, Output, Recipe
from lio_jax.registration.knn_planes import PLANE_SHARE, ScanToPoints
from lio_jax.registration.params import (
    FilterMatch,
    KnnConfig,
    RegistrationConfig,
    ScoredPlaneFitParams,
    ThinnedMatch,
)
from lio_jax.registration.scan_match import FixedPoints

_GYR_COV, _ACC_COV, _B_GYR_COV, _B_ACC_COV = 0.1, 0.1, 1e-4, 1e-4
IMU_RATE = 200.0
"""Rate of the inertial samples of FAST-LIO2's example recordings, Hz."""


def density_of(cov: float) -> float:
    """Return the density that stands for one of FAST-LIO2's covariances, of white noise or of a bias walk.

    FAST-LIO2 adds cov dt^2 to its covariance in each step of dt = 1 / rate; a density s adds s^2 dt. So
    s = sqrt(cov / rate).
    """
    return (cov / IMU_RATE) ** 0.5


class FastLio2Match(FilterMatch, ThinnedMatch):
    """A match of the thinned scan in the filter."""


class FastLio2Params(InertialParams):
    """Traced parameters of FAST-LIO2, in SI units."""

    imu: ImuParams = section(
        ImuParams,
        gyro_noise=density_of(_GYR_COV),
        accel_noise=density_of(_ACC_COV),
        gyro_bias_walk=density_of(_B_GYR_COV),
        accel_bias_walk=density_of(_B_ACC_COV),
    )
    # square roots of its first variances: 1, 1, 1e-4, 1e-3, 1e-5, 1e-5 and 1e-5
    initial: InitialParams = section(
        InitialParams,
        rotation_sigma=1.0,
        velocity_sigma=1.0,
        gyro_bias_sigma=1e-2,
        accel_bias_sigma=1e-3**0.5,
        gravity_sigma=1e-5**0.5,
        extrinsic_rotation_sigma=1e-5**0.5,
        extrinsic_translation_sigma=1e-5**0.5,
    )
    # its variance of a point's distance from its plane is 1e-3 m^2
    lidar: LidarParams = section(LidarParams, range_sigma=1e-3**0.5)
    map: MapParams = section(MapParams, voxel_size=0.5)
    registration: FastLio2Match = section(
        FastLio2Match,
        point_spacing=0.5,
        reassociation_distance=0.01,
        rotation_tolerance=1e-3,
        translation_tolerance=1e-3,
        inertial_degeneracy_ratio=0.0,
    )
    knn: ScoredPlaneFitParams = section(ScoredPlaneFitParams)
    point_map: MovingCubeParams = section(MovingCubeParams)


@dataclass(frozen=True)
class FastLio2ScanConfig(ScanConfig):
    """Capacity of the thinned scan."""

    registration_points: int = static(4096, above=0)
    """Capacity of the downsampled scan that is registered and written into the map."""


@dataclass(frozen=True)
class FilterConfig:
    """Choice of raw points."""

    point_filter_num: int = static(3, above=0)
    """One point of so many is used, counted in the recording's order. A divisor of the number of beams would
    leave whole beams out where the points of a firing follow each other."""
    exact_map: bool = static(False)
    """Whether the map counts as free of errors, as FAST-LIO2 takes it. The covariance of the pose is then far
    too small, and stays so however long the drive is."""


@dataclass(frozen=True)
class FastLio2Config(InertialConfig):
    """Static settings of FAST-LIO2."""

    lidar: FastLio2ScanConfig = section(FastLio2ScanConfig)
    map: MapConfig = section(MapConfig, capacity=65536)
    # its own bound is 4; a scan at 17 m/s takes up to 6 until the pose rests
    registration: RegistrationConfig = section(RegistrationConfig, max_iterations=8)
    knn: KnnConfig = section(KnnConfig)
    fast_lio2: FilterConfig = section(FilterConfig)


class FastLio2State(recipe.State):
    """What is carried from scan to scan."""

    nav: NavState
    """State at the last scan's end."""
    uncertain: NavEstimate
    """What the filter estimates: the navigation state at the last scan's end, and its covariance. Without
    inertial samples that at the scan's middle, where an error of the velocity distorts the scan least."""
    rate: Float[Array, "3"]
    """Mean angular rate between the last two of those instants, rad/s, IMU frame."""
    to_end: Float[Array, ""]
    """Time from that instant to the scan's end, s."""
    scans: Int32[Array, ""]
    """Number of scans with points so far."""
    drift: MapDrift
    """Error of the map around the vehicle. If the map is taken for exact, it is that of the predicted poses
    at which its pieces began."""
    unmatched: Float[Array, ""]
    """Time since the last scan that was matched, s."""
    map: PointMap

    def varying_map(self) -> PointMap:
        """Return which leaves of the map have a derivative: the points."""
        return self.map.varying()

    def with_velocity_of(self, found: "FastLio2State") -> "FastLio2State":
        """Return this first state with the velocity of a later one, and with its angular rate."""

        def motion(state: Any) -> tuple[Any, ...]:
            return state.nav.velocity, state.uncertain.nav.velocity, state.rate

        return eqx.tree_at(motion, self, motion(found))


class FastLio2(Recipe[FastLio2Config, FastLio2Params, FastLio2State]):
    """FAST-LIO2."""

    needs = Needs()
    config_type = FastLio2Config
    params_type = FastLio2Params
    # where walls are near, the voxels and neighbourhoods for streets hold more than one
    near_values: ClassVar[Mapping[str, float]] = {
        "params.lidar.min_range": 0.5,
        "params.map.voxel_size": 0.25,
        "params.registration.point_spacing": 0.25,
        "params.knn.radius": 1.0,
    }

    def init(self, params: FastLio2Params, imu: ImuBatch | None = None) -> FastLio2State:
        """Return the state before the first scan: at the world's origin.

        Args:
            params: traced.
            imu: samples of about a second up to the first scan's end; None: there are no inertial data.
        """
        config = self.config
        start = unlevelled_start(params) if imu is None else levelled_start(params, imu)
        none = jnp.zeros_like(start.nav.velocity)
        return FastLio2State(
            nav=start.nav,
            uncertain=start,
            rate=none,
            to_end=none[0],
            scans=jnp.int32(0),
            drift=MapDrift.none(start.covariance.dtype),
            unmatched=none[0],
            map=empty_map(config.map.capacity),
        )

    def step(
        self, params: FastLio2Params, state: FastLio2State, scan: Scan, imu: ImuBatch | None = None
    ) -> tuple[FastLio2State, Output]:
        """Predict by the inertial samples, correct by the scan, add the scan to the map.

        Args:
            params: traced.
            state: donate it.
            scan: padded sweep; ``scan.interval`` is the time since the last scan's end.
            imu: samples around that time.
        """
        config = self.config
        first, interval = state.scans == 0, scan.interval
        voxel_size = params.map.voxel_size.astype(jnp.float32)
        with jax.named_scope("predict"):
            if imu is None:
                to_end = scan.duration.astype(state.to_end.dtype) / 2
                rate = state.rate * Outage.turning(params, state.unmatched, scan)
                scan = until_its_middle(scan, state.to_end)
                # the first scan's end is the world's origin
                opened = carried_on(state.uncertain.nav, rate, jnp.where(first, -to_end, 0.0))
                last = NavEstimate(opened, state.uncertain.covariance)
                prior, path = predicted_without_samples(params, last, rate, scan, first)
            else:
                to_end = jnp.zeros_like(state.to_end)
                rate = state.rate * Outage.turning(params, state.unmatched, scan)
                # as FAST-LIO2 does, the match is taken for one of the pose at the scan's end
                prior, path = predicted(params, state.uncertain, scan, imu, first, scan.duration, rate)
            T_predicted = lidar_pose(prior.nav)
        with jax.named_scope("thin"):
            points, time, in_range = _filtered(config.fast_lio2.point_filter_num, params, scan)
            points = deskew_along(path, prior.nav.T_imu_lidar, points, time)
            spacing = params.registration.point_spacing.astype(jnp.float32)
            thin = mean_per_voxel(points, in_range, spacing, config.lidar.registration_points)
        with jax.named_scope("update"):
            frame = Frame(*anchor_of(T_predicted.translation(), EDGE * params.map.voxel_size))
            outage = Outage.at(params, state.unmatched + interval, thin.mask)
            match = ScanToPoints(
                points_at=FixedPoints(thin.points),
                T_predicted=T_predicted,
                registration=outage.required(params.registration),
                map=state.map,
                mask=thin.mask,
                map_params=params.map,
                knn=params.knn,
                lidar=params.lidar,
                origin=frame,
                neighbours=config.knn.neighbours,
                # without inertial samples such planes are better than none
                least_width=0.0 if imu is None else params.knn.least_width * params.map.voxel_size,
            )
            considered = None if config.fast_lio2.exact_map else prior.transition @ state.drift.cross
            update, _ = corrected(prior, match, config.registration.max_iterations, considered)
            posterior: NavEstimate = update.state
            lost = (update.status > ITERATION_LIMIT) & ~first
            new_piece = outage.begins_piece(lost, params.registration)
            T_world_lidar = lidar_pose(posterior.nav)
        with jax.named_scope("insert"):
            _, moving = frame.place(thin.points, T_world_lidar)
            placed = jax.lax.stop_gradient(moving)
            side = params.point_map.cube_side_length
            margin = params.point_map.cube_margin * params.lidar.max_range
            in_blocks = jnp.stack([side / 2, margin]).astype(jnp.float32) / (EDGE * voxel_size)
            inserted, added = insert(
                state.map,
                placed,
                thin.mask & (~lost | new_piece),
                frame.anchor,
                voxel_size,
                in_blocks[0],
                params.point_map.nearer_by.astype(jnp.float32),
            )
            # last: XLA copies the map if another operation reads it afterwards
            cube_map = move_cube(inserted, frame.anchor, *in_blocks)
            cube_map = following(cube_map, state.map, inserted, added.added, moving, frame.anchor, voxel_size)

        before, no_sweep = state.uncertain.nav.T_world_imu, jnp.zeros_like(to_end)
        cross = update.considered
        posterior, drift = after_match(posterior, state.drift, cross, before, no_sweep, new_piece)
        after, grown = posterior, drift
        if not config.fast_lio2.exact_map:
            new = jnp.sum(added.added) / jnp.maximum(jnp.sum(thin.mask), 1)
            by_planes = planes_met(update, posterior.nav, jnp.full_like(to_end, PLANE_SHARE))
            after, grown = drift.grown(posterior, new, by_planes, state.scans)
            if imu is None:
                after, grown = with_gravity_held(after, grown)
        seen = jnp.any(thin.mask)
        rate = jnp.where(first | lost, rate, mean_rate(state.uncertain.nav, posterior.nav, scan))
        new_state = FastLio2State(
            nav=carried_on(posterior.nav, rate, to_end) if imu is None else posterior.nav,
            uncertain=after,
            rate=rate,
            to_end=to_end,
            scans=state.scans + seen.astype(jnp.int32),
            drift=grown,
            unmatched=outage.after((first & ~seen) | (lost & ~new_piece)),
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
            covariance=drift.added_to(posterior),
            new_piece=new_piece,
            evidence=evidence_of(update, prior),
            matched=match.counted(T_world_lidar, update.measurement.aux.association.found) & ~lost
            if config.registration.mark_matched
            else None,
        )


def _filtered(
    every: int, params: FastLio2Params, scan: Scan
) -> tuple[Float[Array, "n 3"], Float[Array, " n"], Bool[Array, " n"]]:
    """Return every n-th point, corrected, its time, and whether it is between blind radius and far limit."""
    points, time = scan.points[::every], scan.time[::every]
    squared_range = jnp.sum(points**2, -1)
    near, far = params.lidar.min_range.astype(jnp.float32), params.lidar.max_range.astype(jnp.float32)
    mask = scan.mask[::every] & (squared_range > near**2) & (squared_range < far**2)
    points = jnp.where(mask[:, None], points, 0.0)
    return params.lidar.corrected(points, scan.ring[::every]), time, mask
