"""Every recipe as a pipeline of evalio: measurements in, poses of the IMU out."""

from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np
from evalio._cpp.types import VisOption
from evalio.pipelines import Pipeline
from evalio.types import (
    SE3,
    ImuMeasurement,
    ImuParams,
    LidarMeasurement,
    LidarParams,
    Point,
    Stamp,
)
from numpy.typing import NDArray

from lio_jax.commands.runtime import prepare_jax
from lio_jax.core.leaf import sections_of
from lio_jax.data.evalio_points import points_can_be_copied, scan_of
from lio_jax.data.sequence import LidarScan
from lio_jax.recipes import recipe_named
from lio_jax.run.fitted_settings import with_given_noise, with_sensor_sizes
from lio_jax.run.pushed import PushedOdometry, rehearse
from lio_jax.run.scan_inputs import bucket_for
from lio_jax.run.track import ScanResult, pose_matrix
from lio_jax.settings.settings import Settings, declared_settings, recipe_settings, uses_imu

_OF_THE_CALIBRATION = "extrinsics"
"""Section that evalio itself gives."""


class RecipePipeline(Pipeline):  # type: ignore[misc, unused-ignore]
    """A recipe as evalio drives it; a subclass names the recipe.

    A pose is saved with the stamp of its scan's end, as soon as the inertial samples reach it.
    """

    recipe: ClassVar[str]

    def __init__(self) -> None:
        """Begin with the recipe's own settings; nothing is compiled yet."""
        super().__init__()
        self._params = self.default_params()
        self._imu = ImuParams()
        self._lidar: LidarParams | None = None
        self._T_imu_lidar = np.eye(4)
        self._shown: frozenset[Any] = frozenset()
        self._map: list[NDArray[np.float64]] = []
        self._odometry: PushedOdometry | None = None

    @classmethod
    def name(cls) -> str:
        """Return the name by which evalio's users choose the recipe."""
        return f"lio_jax_{cls.recipe}"

    @classmethod
    def version(cls) -> str:
        """Return the version of this package."""
        return version("lio-jax")

    @classmethod
    def url(cls) -> str:
        """Return nothing: the package has no page yet."""
        return ""

    @classmethod
    def default_params(cls) -> dict[str, bool | int | float | str]:
        """Return the recipe's settings that are a single value, by path such as params.map.voxel_size.

        A value that stays as it is here may be replaced by one that the first scan shows.
        """
        known: dict[str, bool | int | float | str] = {}
        kind = recipe_named(cls.recipe)
        sections = {*sections_of(kind.params_type), *sections_of(kind.config_type)}
        for path, setting in declared_settings(cls.recipe).items():
            value = setting.declared.default
            own = path.split(".")[1] in sections - {_OF_THE_CALIBRATION}
            if own and isinstance(value, bool | int | float | str):
                known[path] = value
        return known

    def set_params(self, params: Any) -> dict[str, bool | int | float | str]:
        """Take parameters, and return those that the recipe does not have."""
        known = {path: value for path, value in params.items() if path in self._params}
        self._params |= known
        return {path: value for path, value in params.items() if path not in known}

    def set_imu_params(self, params: ImuParams) -> None:
        """Take the inertial sensor's noise, rate and gravity."""
        self._imu = params

    def set_lidar_params(self, params: LidarParams) -> None:
        """Take the LiDAR's rows, columns, ranges and rate."""
        self._lidar = params

    def set_imu_T_lidar(self, T: SE3) -> None:
        """Take the pose of the LiDAR in the IMU frame."""
        self._T_imu_lidar = np.asarray(T.to_mat())

    def set_visualizing(self, visualize: Any) -> None:
        """Take what is to be shown; the map is collected only if it is."""
        super().set_visualizing(visualize)
        self._shown = frozenset(visualize or ())

    def initialize(self) -> None:
        """Fit the settings to the sensors, and compile the programs."""
        assert self._lidar is not None, "evalio gives the LiDAR's parameters before"
        prepare_jax()
        scan = _scan_of_size(self._lidar)
        settings = self._fitted(scan)
        rehearse(settings, scan, self._imu.rate)
        self._odometry = PushedOdometry(settings, self._T_imu_lidar)
        # the place of the points is found here, not within the first scan
        points_can_be_copied(LidarMeasurement(Stamp.from_nsec(0), []))

    def add_imu(self, mm: ImuMeasurement) -> None:
        """Take an inertial sample, and estimate the scan that it completes."""
        assert self._odometry is not None, "evalio initialises before"
        self._save(self._odometry.push_imu(mm.stamp.to_nsec(), mm.gyro, mm.accel))

    def add_lidar(self, mm: LidarMeasurement) -> None:
        """Take a scan, and estimate it if the inertial samples reach its end."""
        assert self._odometry is not None, "evalio initialises before"
        assert self._lidar is not None, "evalio gives the LiDAR's parameters before"
        self._save(self._odometry.push_scan(scan_of(mm, self._lidar.rate)))

    def map(self) -> dict[str, list[Point]]:
        """Return the points that were new to the map, m in world; none unless the map is shown."""
        return {"map": _as_points(np.concatenate(self._map) if self._map else np.zeros((0, 3)))}

    def _fitted(self, scan: LidarScan) -> Settings:
        assert self._lidar is not None
        settings = recipe_settings(self.recipe)
        defaults = self.default_params()
        for path, value in self._params.items():
            if value != defaults[path]:
                settings = settings.with_value(path, value, "evalio")
        if uses_imu(settings):
            settings = with_given_noise(settings, self._imu.gyro, self._imu.accel)
            gravity = float(np.linalg.norm(self._imu.gravity))
            if gravity > 0 and "params.imu.gravity" not in settings.given:
                settings = settings.with_value("params.imu.gravity", gravity, "evalio")
        for path, narrower in (("min_range", max), ("max_range", min)):
            own, sensor = settings.values["lidar"][path], getattr(self._lidar, path)
            if sensor > 0 and narrower(own, sensor) != own:
                settings = settings.with_value(f"params.lidar.{path}", sensor, "evalio")
        features = getattr(settings.config, "features", None)
        if features is not None and self._lidar.brand == "Livox":
            settings = settings.with_value("config.features.order", "arrival", "evalio")
        # one padded size: a second one would be compiled in the middle of the run
        size = bucket_for(len(scan.points), settings.config.lidar)
        settings = settings.with_value("config.lidar.buckets", [size], "evalio")
        return with_sensor_sizes(settings, [scan])[0]

    def _save(self, results: list[ScanResult]) -> None:
        for result in results:
            stamp = Stamp.from_nsec(result.stamp_ns)
            if VisOption.MAP in self._shown:
                points, added = _world_points(result), np.asarray(result.output.added)
                self._map.append(points[added & np.asarray(result.output.points_mask)])
            self.save(stamp, SE3.from_mat(result.T_world_imu))
            if VisOption.FEATURES in self._shown:
                self.save(stamp, _features(result))


class LioJaxDefault(RecipePipeline):
    """The project's own recipe."""

    recipe = "default"


class LioJaxFastLio2(RecipePipeline):
    """FAST-LIO2's method."""

    recipe = "fast_lio2"


class LioJaxLioSam(RecipePipeline):
    """LIO-SAM's method, without loops."""

    recipe = "lio_sam"


class LioJaxLoam(RecipePipeline):
    """A-LOAM's method, without inertial samples."""

    recipe = "loam"


def _world_points(result: ScanResult) -> NDArray[np.float64]:
    output = result.output
    return np.asarray(output.points, np.float64) + np.asarray(output.origin, np.float64)


def _features(result: ScanResult) -> dict[str, list[Point]]:
    """Return the scan's points that were matched, m in the lidar frame at the scan's end, by kind."""
    output = result.output
    T_lidar_world = np.linalg.inv(pose_matrix(np.asarray(output.registration.T_world_lidar.wxyz_xyz)))
    points = _world_points(result) @ T_lidar_world[:3, :3].T + T_lidar_world[:3, 3]
    real = np.asarray(output.points_mask)
    if output.corners is None:
        return {"points": _as_points(points[real])}
    corners = np.asarray(output.corners)
    return {
        "corners": _as_points(points[real & corners]),
        "surfaces": _as_points(points[real & ~corners]),
    }


def _as_points(points: NDArray[np.float64]) -> list[Point]:
    made = LidarMeasurement.from_vec_positions(Stamp.from_nsec(0), np.asfortranarray(points))
    return list(made.points)


def _scan_of_size(lidar: LidarParams) -> LidarScan:
    """Return a scan of a box with a return for every firing of the sensor."""
    rows, columns = max(lidar.num_rows, 1), max(lidar.num_columns, 1)
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, columns, endpoint=False), np.linspace(-0.4, 0.2, rows), indexing="ij"
    )
    towards = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    # walls 12 m and 20 m away, ground and ceiling: every direction meets the nearest of them
    walls = np.array([12.0, 20.0, 2.0])
    points = towards * np.min(walls / np.maximum(np.abs(towards), 1e-9), axis=-1, keepdims=True)
    period = 1.0 / lidar.rate
    return LidarScan(
        stamp_ns=10**18,
        points=points.astype(np.float32),
        time=np.repeat(np.arange(columns) * period / columns, rows).astype(np.float32),
        ring=np.tile(np.arange(rows, dtype=np.int32), columns),
        intensity=np.zeros(rows * columns, np.float32),
        duration=period,
    )
