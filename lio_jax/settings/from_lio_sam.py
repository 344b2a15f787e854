"""Translate LIO-SAM's parameters into this project's settings.

Its ``extrinsicRot`` rotates vectors from the IMU's axes to the lidar's axes. Its ``extrinsicTrans`` is the
position of the IMU in the lidar frame: the transform that it calls lidar2Imu translates by +extrinsicTrans
and multiplies the lidar's pose from the right, after the samples are rotated. Together they are T_lidar_imu,
the inverse of ``params.extrinsics``. For KITTI its authors fill in calib_imu_to_velo.
"""

from collections.abc import Mapping
from typing import Any

from scipy.spatial.transform import Rotation

from lio_jax.core.errors import UsageError
from lio_jax.settings.foreign_rules import Rule, System, nothing, quaternion, rotation, same, vector

_SAME_AXES = 0.02
"""Two rotations are taken as equal if they differ by less than this angle, rad."""
_FROM_NAVSAT = "odometry/gps"

_OUTPUT = "names or draws what its nodes publish; a run writes a folder"
_WITH_LOOPS = "counts where loops are closed: config.backend.loops=true"
_WITH_GPS = "counts where fixes are used: config.backend.gps=true"


def _extrinsic_rot(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    settings = {"params.extrinsics.rotation": quaternion(rotation(value, place).inv())}
    return settings, "inverted: it turns from the IMU's axes to the lidar's, ours is T_imu_lidar"


def _extrinsic_trans(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    t_lidar_imu = vector(value, place)
    R_lidar_imu = _rotation_for(place, values)
    translation = [float(item) for item in -R_lidar_imu.inv().apply(t_lidar_imu) + 0.0]
    word = "-extrinsicRot^T extrinsicTrans: it is where the IMU lies in the lidar frame, ours is T_imu_lidar"
    return {"params.extrinsics.translation": translation}, word


def _extrinsic_rpy(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    # some versions invert the matrix before they use it, others do not
    of_orientations, of_samples = rotation(value, place), _rotation_for(place, values)
    if any((of_orientations * other).magnitude() < _SAME_AXES for other in (of_samples, of_samples.inv())):
        return {}, (
            "fits extrinsicRot: the IMU's orientations are of its samples' axes, T_world_imu, as "
            "config.imu.orientation takes them"
        )
    return {"config.imu.orientation": False}, (
        "differs from extrinsicRot: the IMU's orientations are of other axes than its samples, and "
        "config.imu.orientation takes them as T_world_imu"
    )


def _rotation_for(place: str, values: Mapping[str, Any]) -> Rotation:
    if "extrinsicRot" not in values:
        raise UsageError(f"{place} cannot be read without extrinsicRot, which is missing.")
    source = place.rpartition(": ")[0]
    return rotation(values["extrinsicRot"], f"{source}: extrinsicRot")


def _gps_topic(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    if isinstance(value, str) and value.strip("/") == _FROM_NAVSAT:
        return {}, "made by robot_localization while it runs; a NavSatFix of the recording is found by itself"
    return {"config.data.gps_topic": value}, ""


def _sensor(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    order = "arrival" if value == "livox" else "azimuth"
    word = "fields are recognised from the messages; a Livox's points keep their order, others go by azimuth"
    return {"config.features.order": order}, word


def _leaf_size(path: str) -> Rule:
    def take(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
        word = "each leaf of the submap holds the mean of its points, as VoxelGrid leaves it"
        return {path: value, "config.lio_sam.map_points": "mean"}, word

    return Rule(take, method=True, paths=(path,))


def _of_method(path: str, word: str = "") -> Rule:
    return same(path, word=word, method=True)


LIO_SAM = System(
    name="LIO-SAM",
    recipe="lio_sam",
    rules={
        "pointCloudTopic": same("config.data.lidar_topic"),
        "imuTopic": same("config.data.imu_topic"),
        "gpsTopic": Rule(_gps_topic),
        **dict.fromkeys(
            ("odomTopic", "lidarFrame", "baselinkFrame", "odometryFrame", "mapFrame"), nothing(_OUTPUT)
        ),
        "useImuHeadingInitialization": _of_method("config.imu.heading"),
        "useGpsElevation": _of_method("config.backend.gps_elevation", _WITH_GPS),
        "gpsCovThreshold": _of_method("params.gps.max_variance", _WITH_GPS),
        "poseCovThreshold": _of_method("params.gps.pose_variance", _WITH_GPS),
        "savePCD": nothing("map.pcd is written unless config.output.map=false"),
        "savePCDDirectory": nothing("map.pcd lies in the run's folder"),
        "sensor": Rule(_sensor, method=True),
        "N_SCAN": _of_method("config.features.rings"),
        "Horizon_SCAN": _of_method("config.features.columns"),
        "downsampleRate": _of_method("config.features.ring_step"),
        "lidarMinRange": same("params.lidar.min_range"),
        "lidarMaxRange": same("params.lidar.max_range"),
        "imuAccNoise": same("params.imu.accel_noise"),
        "imuGyrNoise": same("params.imu.gyro_noise"),
        "imuAccBiasN": same("params.imu.accel_bias_walk"),
        "imuGyrBiasN": same("params.imu.gyro_bias_walk"),
        "imuGravity": same("params.imu.gravity"),
        "imuRPYWeight": _of_method("params.smoother.tilt_weight"),
        "extrinsicTrans": Rule(_extrinsic_trans),
        "extrinsicRot": Rule(_extrinsic_rot),
        "extrinsicRPY": Rule(_extrinsic_rpy),
        "edgeThreshold": _of_method("params.features.corner_threshold"),
        "surfThreshold": _of_method("params.features.flat_threshold"),
        "edgeFeatureMinValidNum": _of_method("params.submap.min_corners"),
        "surfFeatureMinValidNum": _of_method("params.submap.min_surfaces"),
        "odometrySurfLeafSize": _of_method("params.features.surface_spacing"),
        "mappingCornerLeafSize": _leaf_size("params.map.corner_voxel_size"),
        "mappingSurfLeafSize": _leaf_size("params.map.voxel_size"),
        "z_tollerance": _of_method("params.smoother.height_limit"),
        "rotation_tollerance": _of_method("params.smoother.tilt_limit"),
        "numberOfCores": nothing("the machine's cores are used as JAX finds them"),
        "mappingProcessInterval": _of_method(
            "params.smoother.mapping_interval",
            "leaves the scans in between to the samples; 0, the recipe's own, matches every scan",
        ),
        "surroundingkeyframeAddingDistThreshold": _of_method("params.submap.keyframe_distance"),
        "surroundingkeyframeAddingAngleThreshold": _of_method("params.submap.keyframe_angle"),
        "surroundingKeyframeDensity": _of_method("params.submap.spacing"),
        "surroundingKeyframeSearchRadius": _of_method("params.submap.radius"),
        "loopClosureEnableFlag": _of_method("config.backend.loops"),
        "historyKeyframeSearchRadius": _of_method("params.loop.radius", _WITH_LOOPS),
        "historyKeyframeSearchTimeDiff": _of_method("params.loop.time_gap", _WITH_LOOPS),
        "historyKeyframeSearchNum": _of_method("config.loops.submap_keyframes", _WITH_LOOPS),
        "historyKeyframeFitnessScore": nothing("params.loop.* has tests of its own for a loop"),
        "loopClosureFrequency": nothing("every keyframe is compared, in parallel with the odometry"),
        "surroundingKeyframeSize": nothing("params.submap.* says which keyframes are matched with"),
        **dict.fromkeys(
            (
                "globalMapVisualizationSearchRadius",
                "globalMapVisualizationPoseDensity",
                "globalMapVisualizationLeafSize",
            ),
            nothing(_OUTPUT),
        ),
    },
)
