"""Static settings: what shapes arrays or chooses code. Frozen and hashable, so that jit can key on them.

Everything that is a number to be tuned lives in :mod:`lio_jax.core.params` instead.
"""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class DataConfig:
    """How a recording is read; "auto" or an empty string means: recognised from the data, and said."""

    lidar_topic: str = ""
    """Bag topic of the point clouds; empty: the one with most messages."""
    imu_topic: str = ""
    """Bag topic of the inertial samples; empty: the one with most messages."""
    gps_topic: str = ""
    """Bag topic used as GPS; empty: a NavSatFix, or an Odometry whose name holds gps, gnss or rtk."""
    time_field: str = ""
    """Name of the per-point time field; empty: t, time, timestamp, time_stamp, offset_time or timeOffset."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the per-point time field."""
    time_reference: Literal["auto", "relative", "absolute"] = "auto"
    """Whether per-point times count from the scan or from the epoch."""
    stamp_at: Literal["auto", "start", "end"] = "auto"
    """Which end of the scan the message's header stamp marks."""
    accel_unit: Literal["auto", "m/s^2", "g"] = "auto"
    """Unit of the accelerometer."""
    compensated: Literal["auto", "yes", "no"] = "auto"
    """Whether the recording's points are already motion compensated (KITTI odometry: yes)."""
    vertical_correction_deg: float = 0.205
    """Correction of the HDL-64E's elevation angles, applied to KITTI odometry scans only, deg."""
    beams: int = 0
    """Beams for ring reconstruction where the recording holds no ring; 0: 16, 32 or 64 by the data."""
    scan_period: float = 0.1
    """Duration of one sweep where it cannot be read from the data, s."""
    prefetch: int = 3
    """Number of scans decoded ahead on a thread."""


@dataclass(frozen=True)
class LidarConfig:
    """Capacities of the scan's arrays."""

    buckets: tuple[int, ...] = (4096, 8192, 16384, 32768, 65536, 98304, 131072, 196608, 262144)
    """Padded scan sizes; a scan takes the smallest that holds it, a larger one is thinned to the last."""
    registration_points: int = 12288
    """Capacity of the downsampled scan that is registered."""
    insertion_points: int = 32768
    """Capacity of the downsampled scan that is written into the map."""


@dataclass(frozen=True)
class ImuConfig:
    """Use of the inertial samples."""

    use: bool = True
    """Couple the recording's inertial samples in; false: LiDAR odometry."""
    buckets: tuple[int, ...] = (32, 64, 128, 256, 512, 1024, 2048)
    """Padded numbers of samples between two scans; more than the last are thinned to it."""
    registration_points: int = 2048
    """Takes the place of ``config.lidar.registration_points``: with inertial samples fewer points will do."""
    insertion_points: int = 8192
    """Takes the place of ``config.lidar.insertion_points``."""
    orientation: bool = False
    """Use the attitude that a 9-axis IMU reports itself, where the recipe can (lio_sam)."""
    heading: bool = False
    """Begin with its heading too."""


@dataclass(frozen=True)
class MapConfig:
    """Capacity of the voxel map."""

    capacity: int = 131072
    """Number of voxel slots, a power of two."""


@dataclass(frozen=True)
class RegistrationConfig:
    """Bounds of the scan-to-map solve."""

    max_iterations: int = 60
    """Gauss-Newton steps at most."""


@dataclass(frozen=True)
class KnnConfig:
    """Matching by nearest neighbours."""

    neighbours: int = 5
    """Map points through which a plane is fitted."""


@dataclass(frozen=True)
class FeaturesConfig:
    """Corners and flat points along the sensor's rings."""

    rings: int = 64
    """Rings of the sensor; points of a ring beyond are reported as dropped. 0: by the recording's first
    scans."""
    ring_step: int = 1
    """Every how many rings one is used."""
    columns: int = 2304
    """Columns of a full turn where points are ordered by azimuth; else the points a ring has room for. 0: by
    the recording's first scans."""
    order: Literal["arrival", "azimuth"] = "arrival"
    """How a ring's points follow each other: as the recording has them (A-LOAM; the lines of a Livox), or by
    columns of equal azimuth, of which the first point takes each (LIO-SAM)."""
    neighbours: int = 5
    """Points on either side that make up the smoothness of a point, and that a pick suppresses; as many are
    left unused at both ends of a ring."""
    sectors: int = 6
    """Sectors of a ring, picked from one after another."""
    sharp: int = 2
    """Sharpest corners of a sector, which are matched against the less sharp ones."""
    corners: int = 20
    """Corners of a sector, the sharpest included."""
    flat: int = 4
    """Flattest points of a sector, which are matched against the surfaces."""
    surface_points: int = 49152
    """Capacity of the downsampled surface points. 0: by the recording's first scans."""


@dataclass(frozen=True)
class FastLio2Config:
    """What the recipe fast_lio2 has of its own."""

    point_filter_num: int = 3
    """Every how many points of a scan one is used, counted in the recording's order: a divisor of the beams'
    number would leave whole beams out where the points of a firing follow each other."""


@dataclass(frozen=True)
class LoamConfig:
    """What the recipe loam has of its own."""

    rounds: int = 2
    """How often a scan's matches are searched; each time ``config.registration.max_iterations`` steps follow
    at most."""
    opening_rounds: int = 15
    """Takes the place of ``rounds`` between the first two scans: no velocity is known there."""
    compensate: bool = True
    """Compensate the motion within a scan, as the pose under trial implies it."""
    mapping_every: int = 1
    """Every how many scans one is matched with the map and added to it."""
    corner_points: int = 4096
    """Capacity of the corners that are matched with the map, after thinning."""
    surface_points: int = 8192
    """Capacity of the surface points that are matched with the map, after thinning."""


@dataclass(frozen=True)
class LioSamConfig:
    """What the recipe lio_sam has of its own."""

    window: int = 10
    """States that are smoothed together; what is older is marginalised."""
    smoother_iterations: int = 5
    """Linearisations of the window at most."""
    lidar_noise: Literal["fixed", "information"] = "fixed"
    """What the smoother believes of a scan match: the sigmas of ``params.smoother``, or its information."""
    keyframes: int = 256
    """Capacity; where it is reached the oldest is forgotten, such as it is not needed any more first."""
    corner_points: int = 2048
    """Capacity of the corners that are matched with the map, after thinning."""
    surface_points: int = 8192
    """Capacity of the surface points that are matched with the map, after thinning."""


@dataclass(frozen=True)
class BackendConfig:
    """What corrects the odometry's drift, beside any recipe."""

    loops: bool = False
    """Recognise places seen before and close loops."""
    gps: bool = False
    """Tie the trajectory to the recording's GPS fixes."""
    gps_elevation: bool = True
    """Use their height too; false: the odometry's stands."""


@dataclass(frozen=True)
class LoopsConfig:
    """Sizes of what is compared where a place may have been seen before."""

    pairs: str = ""
    """File of pairs of times at which the same place was seen, by whatever other method; empty: none."""
    submap_keyframes: int = 25
    """Keyframes on either side of an earlier one that make up its surroundings."""
    source_keyframes: int = 10
    """Keyframes up to the newest that are compared with these surroundings together."""
    source_points: int = 2048
    """Capacity of the points to be aligned, after thinning."""
    target_points: int = 65536
    """Capacity of the surroundings, after thinning."""
    starts: int = 5
    """Alignments that are tried: the best one and its rivals."""
    rings: int = 20
    """Of a place's descriptor, from the sensor outwards."""
    sectors: int = 60
    """Of a place's descriptor, all around."""


@dataclass(frozen=True)
class OutputConfig:
    """Which of the optional files a run folder gets."""

    map: bool = True
    """Write map.pcd."""
    recording: bool = True
    """Write recording.rrd."""
    plot: bool = True
    """Write trajectory.png and timings.png."""
    report: bool = True
    """Write report.html."""
    keyframe_distance: float = 1.0
    """A scan this far from the last keyframe becomes one, m."""
    keyframe_angle: float = 0.2
    """A scan turned this much from the last keyframe becomes one, rad."""


@dataclass(frozen=True)
class Config:
    """All static settings of a run."""

    data: DataConfig = field(default_factory=DataConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    map: MapConfig = field(default_factory=MapConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    knn: KnnConfig = field(default_factory=KnnConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    fast_lio2: FastLio2Config = field(default_factory=FastLio2Config)
    loam: LoamConfig = field(default_factory=LoamConfig)
    lio_sam: LioSamConfig = field(default_factory=LioSamConfig)
    backend: BackendConfig = field(default_factory=BackendConfig)
    loops: LoopsConfig = field(default_factory=LoopsConfig)
    output: OutputConfig = field(default_factory=OutputConfig)


_MAY_BE_ZERO = {
    "config.data.beams",
    "config.data.prefetch",
    "config.features.rings",
    "config.features.columns",
    "config.features.surface_points",
}


def invalid_config(path: str, value: object) -> str:
    """Return why a setting's value is impossible ("must be ..."), or nothing if it is possible."""
    if path == "config.map.capacity" and (not isinstance(value, int) or value < 2 or value & (value - 1)):
        return "must be a power of two"
    if path == "config.knn.neighbours" and isinstance(value, int) and value < 3:
        return "must be at least 3: fewer points define no plane"
    if path == "config.lio_sam.window" and isinstance(value, int) and value < 2:
        return "must be at least 2: the smoother ties each state to the one before it"
    if path.endswith(".buckets") and (sorted(set(value)) != list(value) or value[0] < 1):  # type: ignore
        return "must be positive sizes in ascending order"
    if path == "config.data.vertical_correction_deg":
        return ""
    if isinstance(value, int | float) and not isinstance(value, bool):
        if path in _MAY_BE_ZERO:
            return "" if value >= 0 else "must not be negative"
        return "" if value > 0 else "must be greater than zero"
    return ""
