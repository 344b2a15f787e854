"""The values in which each recipe differs from the defaults of :mod:`lio_jax.core.config` and ``params``."""

from typing import Any

_GYR_COV, _ACC_COV, _B_GYR_COV, _B_ACC_COV = 0.1, 0.1, 1e-4, 1e-4
FAST_LIO2_IMU_RATE = 200.0
"""Of its example recordings, Hz."""


def fast_lio2_density(cov: float) -> float:
    """Return the density that stands for one of FAST-LIO2's covariances, of white noise or of a bias walk.

    It adds cov dt^2 to its covariance in each step of dt = 1 / rate; a density s adds s^2 dt. So
    s = sqrt(cov / rate).
    """
    return (cov / FAST_LIO2_IMU_RATE) ** 0.5


_DEGREE = 3.141592653589793 / 180

RECIPE_VALUES: dict[str, dict[str, Any]] = {
    "default": {},
    "fast_lio2": {
        "config.lidar.registration_points": 4096,
        "config.map.capacity": 65536,
        "config.registration.max_iterations": 4,
        "params.imu.gyro_noise": fast_lio2_density(_GYR_COV),
        "params.imu.accel_noise": fast_lio2_density(_ACC_COV),
        "params.imu.gyro_bias_walk": fast_lio2_density(_B_GYR_COV),
        "params.imu.accel_bias_walk": fast_lio2_density(_B_ACC_COV),
        # square roots of its first variances: 1, 1, 1e-4, 1e-3, 1e-5, 1e-5 and 1e-5
        "params.initial.rotation_sigma": 1.0,
        "params.initial.velocity_sigma": 1.0,
        "params.initial.gyro_bias_sigma": 1e-2,
        "params.initial.accel_bias_sigma": 1e-3**0.5,
        "params.initial.gravity_sigma": 1e-5**0.5,
        "params.initial.extrinsic_rotation_sigma": 1e-5**0.5,
        "params.initial.extrinsic_translation_sigma": 1e-5**0.5,
        # its variance of a point's distance from its plane is 1e-3 m^2
        "params.lidar.range_sigma": 1e-3**0.5,
        "params.lidar.min_range": 2.0,
        "params.lidar.max_range": 100.0,
        "params.map.voxel_size": 0.5,
        "params.registration.point_spacing": 0.5,
        "params.registration.information_scale": 1.0,
        "params.registration.reassociation_distance": 0.01,
        "params.registration.rotation_tolerance": 1e-3,
        "params.registration.translation_tolerance": 1e-3,
        "params.registration.inertial_degeneracy_ratio": 0.0,
    },
    "loam": {
        "config.imu.use": False,
        # by the recording
        "config.features.rings": 0,
        "config.features.columns": 0,
        "config.features.surface_points": 0,
        "config.map.capacity": 65536,
        "config.registration.max_iterations": 4,
        "params.lidar.min_range": 0.3,
        "params.map.voxel_size": 0.8,
        "params.map.corner_voxel_size": 0.4,
        "params.registration.kernel": 0.1,
        "params.registration.reassociation_distance": 0.05,
        "params.registration.rotation_tolerance": 1e-3,
        "params.registration.translation_tolerance": 1e-3,
        "params.registration.degeneracy_ratio": 1e-4,
        "params.knn.radius": 1.0,
        "params.knn.plane_tolerance": 0.2,
    },
    "lio_sam": {
        # by the recording
        "config.features.rings": 0,
        "config.features.columns": 0,
        "config.features.surface_points": 0,
        "config.features.order": "azimuth",
        "config.imu.orientation": True,
        "config.map.capacity": 65536,
        "config.registration.max_iterations": 30,
        "params.imu.gyro_noise": 1.5636343949698187e-03,
        "params.imu.accel_noise": 3.9939570888238808e-03,
        "params.imu.gyro_bias_walk": 3.5640318696367613e-05,
        "params.imu.accel_bias_walk": 6.4356659353532566e-05,
        "params.imu.gravity": 9.80511,
        "params.initial.rotation_sigma": 1e-2,
        # LIO-SAM's 1e4 beside a sample's information is singular in double precision
        "params.initial.velocity_sigma": 100.0,
        "params.initial.gyro_bias_sigma": 1e-3,
        "params.initial.accel_bias_sigma": 1e-3,
        "params.lidar.min_range": 1.0,
        "params.lidar.max_range": 1000.0,
        "params.map.voxel_size": 0.4,
        "params.map.corner_voxel_size": 0.2,
        "params.features.corner_threshold": 1.0,
        "params.features.flat_threshold": 0.1,
        "params.features.surface_spacing": 0.4,
        "params.registration.reassociation_distance": 0.05,
        "params.registration.rotation_tolerance": 0.05 * _DEGREE,
        "params.registration.translation_tolerance": 5e-4,
        "params.knn.radius": 1.0,
        "params.knn.plane_tolerance": 0.2,
        "params.knn.min_score": 0.1,
        "config.backend.gps_elevation": False,
        "params.gps.pose_variance": 25.0,
        "params.gps.max_variance": 2.0,
        # keyframes within 50 m see farther than that
        "params.point_map.cube_side_length": 400.0,
    },
}
"""By recipe; paths as in a settings file."""
