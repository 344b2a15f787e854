"""Parameters of the back end (loops, GPS fixes, pose graph of keyframes), and of a start in a known map."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
from jaxtyping import Array, Float

from lio_jax.core.leaf import leaf, section, static
from lio_jax.core.types import Scalar
from lio_jax.lidar.params import BeamParams
from lio_jax.mapping.params import VoxelMapParams
from lio_jax.registration.params import GaussNewtonMatch, RobustMatch


class BackendParams(eqx.Module):
    """How far the back end trusts the odometry."""

    odometry_scale: Scalar = leaf(3.0, above=0, tuned="log")
    """Factor of the standard deviations that the estimator states for its error from one keyframe to the
    next. They are added to the two below."""
    odometry_rotation_sigma: Scalar = leaf(1e-3, "rad", above=0, tuned="log")
    """Standard deviation of the rotation from one keyframe to the next that the estimator does not state."""
    odometry_translation_sigma: Scalar = leaf(1e-2, "m", above=0, tuned="log")
    """Standard deviation of the translation from one keyframe to the next that the estimator does not
    state."""
    tilt_sigma: Scalar = leaf(0.1, "rad", above=0)
    """Standard deviation of the first keyframe's roll and pitch, where GPS ties the trajectory to the
    world."""


class LoopParams(eqx.Module):
    """Which places are compared, and what has to hold before a loop is closed."""

    radius: Scalar = leaf(15.0, "m", above=0)
    """The nearest earlier keyframe within this distance is compared, if it is older than ``time_gap``."""
    time_gap: Scalar = leaf(30.0, "s", above=0)
    """A keyframe is compared with keyframes that are older than this."""
    drift: Scalar = leaf(0.05, "m/m", least=0)
    """Largest error of position that the odometry may have accumulated, per metre travelled."""
    heading_drift: Scalar = leaf(1e-3, "rad/m", least=0)
    """Largest error of heading that the odometry may have accumulated, per metre travelled."""
    tilt: Scalar = leaf(0.1, "rad", above=0)
    """Largest error of roll and pitch that a loop may correct."""
    descriptor_range: Scalar = leaf(60.0, "m", above=0)
    """Range of the farthest points that describe a place."""
    descriptor_distance: Scalar = leaf(0.5, above=0, most=1)
    """Places whose descriptors differ by more than this are not compared, 0 to 1."""
    aligning_voxel: Scalar = leaf(1.2, "m", above=0)
    """Voxel size of the map that a scan is aligned with in the last stage; the first stage uses twice
    this."""
    overlap_distance: Scalar = leaf(0.5, "m", above=0)
    """A point agrees with the map if the map has a point nearer than this."""
    overlap: Scalar = leaf(0.7, above=0, most=1)
    """Smallest share of points on upright surfaces that agree."""
    fitness: Scalar = leaf(0.12, "m^2", above=0)
    """Largest mean squared distance to the map of the points that have the map near."""
    conflict: Scalar = leaf(0.3, above=0, most=1)
    """Largest share of the map's upright surfaces that stand where the scan's rays passed through."""
    rival: Scalar = leaf(0.9, above=0, most=1)
    """No other alignment may reach more than this share of the best alignment's agreeing points."""
    rotation_sigma: Scalar = leaf(0.005, "rad", least=0, tuned="log")
    """Smallest standard deviation of a loop's rotation."""
    translation_sigma: Scalar = leaf(0.1, "m", least=0, tuned="log")
    """Smallest standard deviation of a loop's translation."""
    support_reach: Scalar = leaf(50.0, "m", above=0)
    """Two loops confirm or contradict each other if both ends are no farther apart than this, along the
    path."""


class GpsParams(eqx.Module):
    """Which GPS fixes tie the trajectory to the earth, and how far they are trusted."""

    lever_arm: Float[Array, "3"] = leaf((0.0, 0.0, 0.0), "m", tuned="linear")
    """Position of the antenna in the IMU frame."""
    min_travel: Scalar = leaf(5.0, "m", least=0)
    """Fixes are used once the trajectory is this long."""
    pose_variance: Scalar = leaf(0.0, "m^2", least=0)
    """A pose whose variances along x and along y are below this gets no fix."""
    time_gap: Scalar = leaf(0.2, "s", above=0)
    """Largest time between a fix and its keyframe."""
    interpolation: Scalar = leaf(2.0, "s", least=0)
    """The position is interpolated between two fixes that are no farther apart than this."""
    max_variance: Scalar = leaf(400.0, "m^2", above=0)
    """Fixes with a larger variance to the east or north are left out."""
    min_variance: Scalar = leaf(1.0, "m^2", above=0, tuned="log")
    """Smallest variance of an axis that is believed, because consecutive errors of fixes are correlated."""
    height_variance: Scalar = leaf(0.01, "m^2", above=0, tuned="log")
    """Variance of the height where the height is the odometry's and not the fix's."""
    spacing: Scalar = leaf(5.0, "m", least=0)
    """Keyframes nearer than this to the last keyframe with a fix get none."""
    jump_sigmas: Scalar = leaf(4.0, "sigmas", above=0)
    """Two fixes are consistent if their distance differs from the odometry's by less than this many sigmas
    plus ``drift`` times the path between them."""
    drift: Scalar = leaf(0.05, "m/m", least=0)
    """Drift of the odometry that the consistency test of fixes allows, per metre travelled."""
    yaw_sigma: Scalar = leaf(0.1, "rad", above=0)
    """The heading counts as known once its standard deviation is below this."""


class KnownMapParams(eqx.Module):
    """Where a run begins in a known map."""

    position: Float[Array, "3"] = leaf((0.0, 0.0, 0.0), "m")
    """Position of the IMU at the first scan, in the map's world; by default where the map's run began."""
    heading: Scalar = leaf(0.0, "rad")
    """Heading of the IMU's x axis at the first scan, from the map's x axis, counterclockwise."""
    position_error: Scalar = leaf(5.0, "m", above=0, most=15)
    """Largest horizontal error of ``position``."""
    heading_error: Scalar = leaf(0.5, "rad", above=0, most=3.15)
    """Largest error of ``heading``; 3.15 tries all headings."""


@dataclass(frozen=True)
class KnownMapConfig:
    """The map of an earlier run, in whose world a run takes place."""

    path: str = static("")
    """Folder of the earlier run, or a map of it (.pcd or .ply); empty: the run begins a map of its own."""
    search: bool = static(False)
    """Search the start along the trajectory of the earlier run; false: it is at ``params.known_map``."""


@dataclass(frozen=True)
class BackendConfig:
    """What corrects the odometry's drift."""

    loops: bool = static(False)
    """Recognise places seen before and close loops."""
    gps: bool = static(False)
    """Tie the trajectory to the recording's GPS fixes."""
    gps_elevation: bool = static(True)
    """Use the height of the fixes; false: the height is the odometry's."""
    feedback: bool = static(False)
    """Move the keyframes that scans are matched with to their corrected poses, and the odometry's state with
    them; only in the recipe lio_sam."""


@dataclass(frozen=True)
class LoopsConfig:
    """Sizes of what is compared where a place may have been seen before."""

    pairs: str = static("")
    """File of pairs of times at which the same place was seen, found by any other method; empty: none."""
    submap_keyframes: int = static(25, above=0)
    """Keyframes on either side of an earlier keyframe that make up its local map."""
    source_keyframes: int = static(10, above=0)
    """Keyframes up to the newest one that are compared with the local map together."""
    source_points: int = static(2048, above=0)
    """Capacity of the points to be aligned, after thinning."""
    target_points: int = static(65536, above=0)
    """Capacity of the local map, after thinning."""
    starts: int = static(5, above=0)
    """Number of alignments that are tried: the best start and its rivals."""
    rings: int = static(20, above=0)
    """Rings of a place's descriptor, from the sensor outwards."""
    sectors: int = static(60, above=0)
    """Sectors of a place's descriptor over the full turn."""


class AlignmentMatch(GaussNewtonMatch, RobustMatch):
    """The match of two local clouds by Gauss-Newton."""


class AlignmentParams(eqx.Module):
    """What the alignment of two places reads; it is the same with any recipe."""

    lidar: BeamParams = section(BeamParams)
    map: VoxelMapParams = section(VoxelMapParams)
    registration: AlignmentMatch = section(AlignmentMatch)


@runtime_checkable
class RunSettings(Protocol):
    """The static settings of a run, as far as the back end reads them."""

    @property
    def loops(self) -> LoopsConfig:
        """Sizes of what is compared."""
        ...


@runtime_checkable
class BackEndSettings(Protocol):
    """The settings of a run, as far as the back end reads them."""

    @property
    def run(self) -> RunSettings:
        """Static settings."""
        ...

    @property
    def values(self) -> Mapping[str, Mapping[str, Any]]:
        """Numbers by section and name: ``loop``, ``gps``, ``backend``, ``registration``."""
        ...
