"""The default value of every parameter, which of them have a derivative, and which values are possible.

Paths are a section and a name of :mod:`lio_jax.core.params`, such as ``lidar.range_sigma``.
"""

from typing import Any

DEFAULTS: dict[str, dict[str, Any]] = {
    "imu": {
        "gyro_noise": 2e-3,
        "accel_noise": 2e-2,
        "gyro_bias_walk": 2e-5,
        "accel_bias_walk": 2e-4,
        "gravity": 9.80665,
    },
    "initial": {
        "rotation_sigma": 0.0,
        "velocity_sigma": 10.0,
        "gyro_bias_sigma": 0.01,
        "accel_bias_sigma": 0.1,
        "gravity_sigma": 0.1,
        "extrinsic_rotation_sigma": 0.0,
        "extrinsic_translation_sigma": 0.0,
        "time_offset_sigma": 0.0,
    },
    "lidar": {
        "range_sigma": 0.045,
        "surface_sigma": 0.0,
        "angle_sigma": 0.0,
        "min_range": 2.0,
        "max_range": 100.0,
    },
    "map": {
        "voxel_size": 1.2,
        "corner_voxel_size": 0.4,
        "point_spacing": 0.25,
        "min_points": 3.0,
        "reach": 120.0,
    },
    "registration": {
        "point_spacing": 0.4,
        "inertial_point_spacing": 0.5,
        "kernel": 0.15,
        "information_scale": 0.03,
        "reassociation_distance": 0.015,
        "rotation_tolerance": 1e-4,
        "translation_tolerance": 1e-3,
        "degeneracy_ratio": 0.01,
        "inertial_degeneracy_ratio": 0.003,
        "min_matches": 50.0,
    },
    "scan_to_scan": {"radius": 5.0, "rings_apart": 2.5},
    "knn": {
        "radius": 5**0.5,
        "plane_tolerance": 0.1,
        "line_ratio": 3.0,
        "distance_weight": 0.9,
        "min_score": 0.9,
    },
    "features": {
        "corner_threshold": 0.1,
        "flat_threshold": 0.1,
        "connected_distance": 0.05**0.5,
        "connected_columns": 10.0,
        "occlusion_step": 0.3,
        "occlusion_columns": 10.0,
        "parallel_ratio": 0.02,
        "surface_spacing": 0.2,
    },
    "point_map": {"cube_side_length": 1000.0, "cube_margin": 1.5, "nearer_by": 0.1},
    "cubes": {
        "edge": 50.0,
        "across": 21.0,
        "up": 11.0,
        "margin": 3.0,
        "matched_across": 5.0,
        "matched_up": 3.0,
    },
    "submap": {
        "keyframe_distance": 1.0,
        "keyframe_angle": 0.2,
        "radius": 50.0,
        "spacing": 2.0,
        "recent": 10.0,
        "min_corners": 10.0,
        "min_surfaces": 100.0,
    },
    "smoother": {
        "rotation_sigma": 0.05,
        "translation_sigma": 0.1,
        "degenerate_sigma": 1.0,
        "kernel": 1e6,
        "position_sigma": 0.01,
        "tolerance": 1e-3,
        "tilt_weight": 0.01,
        "tilt_limit": 1000.0,
        "height_limit": 1000.0,
        "mapping_interval": 0.0,
    },
    "motion": {"initial_error": 2.0, "error_decay": 0.5},
    "loop": {
        "radius": 15.0,
        "time_gap": 30.0,
        "drift": 0.05,
        "heading_drift": 1e-3,
        "tilt": 0.1,
        "descriptor_range": 60.0,
        "descriptor_distance": 0.5,
        "aligning_voxel": 1.2,
        "overlap_distance": 0.5,
        "overlap": 0.7,
        "fitness": 0.12,
        "conflict": 0.3,
        "rival": 0.9,
        "rotation_sigma": 0.005,
        "translation_sigma": 0.1,
        "support_reach": 50.0,
    },
    "limits": {"speed": 30.0, "gyro_bias": 1.0, "accel_bias": 1.0, "outage": 1.0},
    "backend": {
        "odometry_rotation_sigma": 1e-3,
        "odometry_translation_sigma": 1e-2,
        "tilt_sigma": 0.1,
    },
    "gps": {
        "lever_arm": [0.0, 0.0, 0.0],
        "min_travel": 5.0,
        "pose_variance": 0.0,
        "time_gap": 0.2,
        "interpolation": 2.0,
        "max_variance": 400.0,
        "min_variance": 1.0,
        "height_variance": 0.01,
        "spacing": 5.0,
        "jump_sigmas": 4.0,
        "drift": 0.05,
        "yaw_sigma": 0.1,
    },
    "extrinsics": {"rotation": [0.0, 0.0, 0.0, 1.0], "translation": [0.0, 0.0, 0.0], "time_offset": 0.0},
}
"""Values of the default recipe in the units of the leaves above."""

DIFFERENTIABLE = (
    *(f"imu.{name}" for name in DEFAULTS["imu"]),
    *(f"initial.{name}" for name in DEFAULTS["initial"]),
    "lidar.range_sigma",
    "lidar.surface_sigma",
    "lidar.angle_sigma",
    "registration.kernel",
    "registration.information_scale",
    "knn.distance_weight",
    *(f"smoother.{name}" for name in ("rotation_sigma", "translation_sigma", "degenerate_sigma")),
    *(f"smoother.{name}" for name in ("kernel", "position_sigma", "tilt_weight")),
    *(f"extrinsics.{name}" for name in DEFAULTS["extrinsics"]),
)
"""Leaves with a derivative. The others choose: which points, which voxels, when to stop, what to report."""

_ANY_SIGN = {"extrinsics.translation", "extrinsics.time_offset", "gps.lever_arm"}
_MAY_BE_ZERO = {
    *(f"initial.{name}" for name in DEFAULTS["initial"]),
    "lidar.min_range",
    "lidar.surface_sigma",
    "lidar.angle_sigma",
    "registration.reassociation_distance",
    "knn.distance_weight",
    "knn.min_score",
    "point_map.cube_margin",
    "point_map.nearer_by",
    "submap.spacing",
    "submap.recent",
    "submap.min_corners",
    "submap.min_surfaces",
    "smoother.tilt_weight",
    "smoother.mapping_interval",
    "motion.initial_error",
    "registration.degeneracy_ratio",
    "registration.inertial_degeneracy_ratio",
    "motion.error_decay",
    "gps.min_travel",
    "gps.pose_variance",
    "gps.interpolation",
    "gps.spacing",
    "gps.drift",
    "loop.drift",
    "loop.heading_drift",
    "loop.rotation_sigma",
    "loop.translation_sigma",
}
_AT_MOST_ONE = {
    *(f"loop.{name}" for name in ("descriptor_distance", "overlap", "conflict", "rival")),
    "knn.min_score",
    "smoother.tilt_weight",
    "motion.error_decay",
    "registration.degeneracy_ratio",
    "registration.inertial_degeneracy_ratio",
    "registration.information_scale",
}


def invalid_value(path: str, value: Any) -> str:
    """Return why a parameter's value is impossible ("must be ..."), or nothing if it is possible.

    Args:
        path: section and name, such as ``lidar.range_sigma``.
        value: a finite number or a list of them.
    """
    if path in _ANY_SIGN:
        return ""
    if path == "extrinsics.rotation":
        norm = sum(x * x for x in value) ** 0.5
        return "" if abs(norm - 1) < 1e-3 else f"must be a unit quaternion x y z w (its norm is {norm:.4g})"
    if path in _AT_MOST_ONE and value > 1:
        return "must be at most 1"
    if path == "scan_to_scan.rings_apart" and value > 3:
        return "must be at most 3"
    if path in _MAY_BE_ZERO:
        return "" if value >= 0 else "must not be negative"
    return "" if value > 0 else "must be greater than zero"
