"""Translate FAST-LIO2's parameters into this project's settings.

Its ``extrinsic_R`` and ``extrinsic_T`` are the lidar's pose in the IMU frame, T_imu_lidar as here.
"""

from collections.abc import Mapping
from typing import Any

from lio_jax.core.errors import UsageError
from lio_jax.core.leaf import numbers_of
from lio_jax.recipes.fast_lio2 import IMU_RATE, FastLio2Params, density_of
from lio_jax.settings.foreign_rules import (
    Rule,
    System,
    converted,
    flag,
    nothing,
    number,
    quaternion,
    rotation,
    same,
    vector,
    whole_number,
)

_UNITS = ("s", "ms", "us", "ns")
_LIVOX = 1
_ESTIMATED = ("params.initial.extrinsic_rotation_sigma", "params.initial.extrinsic_translation_sigma")
_OUTPUT = "chooses what its node publishes or saves; a run writes a folder"
_PUBLISHED = "a run publishes nothing; config.output.clouds=all (dense) or thinned writes a scan's points"


def _density(value: Any, place: str) -> float:
    variance = number(value, place)
    if variance <= 0:
        raise UsageError(f"{place} = {value!r} must be greater than zero.")
    return density_of(variance)


def _noise(path: str) -> Rule:
    word = f"density, sqrt(cov / rate) at {IMU_RATE:g} Hz: its covariances are of one step"
    return converted(path, by=_density, word=word, method=True)


def _timestamp_unit(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    unit = whole_number(value, place)
    if not 0 <= unit < len(_UNITS):
        meant = ", ".join(f"{at} ({name})" for at, name in enumerate(_UNITS))
        raise UsageError(f"{place} = {value!r} must be one of {meant}.")
    if values.get("lidar_type") == _LIVOX:
        return {}, "lidar_type 1, Livox: its messages say ns"
    return {"config.data.time_unit": _UNITS[unit]}, ""


def _scan_period(value: Any, place: str) -> float:
    rate = number(value, place)
    if rate <= 0:
        raise UsageError(f"{place} = {value!r} must be greater than zero.")
    return 1 / rate


def _updates(value: Any, place: str) -> int:
    return whole_number(value, place) + 1


def _saved(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    if not flag(value, place):
        return {"config.output.clouds": "none"}, ""
    word = "all points whatever dense_publish_en says, as there; those between every n-th are not left out"
    return {"config.output.clouds": "all"}, word


def _scans_per_file(value: Any, place: str) -> int:
    interval = whole_number(value, place)
    return interval if interval > 0 else 0


def _estimated(value: Any, place: str, values: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    if flag(value, place):
        own = numbers_of(FastLio2Params)["initial"]
        return {
            path: own[path.rpartition(".")[2]] for path in _ESTIMATED
        }, "estimated where the sigma is not zero"
    return dict.fromkeys(_ESTIMATED, 0.0), "a sigma of zero keeps T_imu_lidar as it is"


FAST_LIO2 = System(
    name="FAST-LIO2",
    recipe="fast_lio2",
    sections=("common", "preprocess", "mapping"),
    rules={
        "lid_topic": same("config.data.lidar_topic"),
        "imu_topic": same("config.data.imu_topic"),
        "time_sync_en": converted(
            "config.data.align_clocks", by=flag, word="only clocks that differ by more than 1 s, as there"
        ),
        "time_offset_lidar_to_imu": same("params.extrinsics.time_offset", word="the same sign"),
        "lidar_type": nothing("recognised from the messages"),
        "scan_line": nothing("rings are read or reconstructed from the points"),
        "blind": same("params.lidar.min_range"),
        "timestamp_unit": Rule(_timestamp_unit),
        "scan_rate": converted("config.data.scan_period", by=_scan_period, word="1 / scan_rate"),
        "feature_extract_enable": nothing("the recipe fast_lio2 matches raw points"),
        "point_filter_num": same("config.fast_lio2.point_filter_num", method=True),
        "max_iteration": converted(
            "config.registration.max_iterations",
            by=_updates,
            word="one more: it counts from -1",
            method=True,
        ),
        "filter_size_corner": nothing("unused there too"),
        "filter_size_surf": same("params.registration.point_spacing", method=True),
        "filter_size_map": same("params.map.voxel_size", method=True),
        "cube_side_length": same("params.point_map.cube_side_length", method=True),
        "acc_cov": _noise("params.imu.accel_noise"),
        "gyr_cov": _noise("params.imu.gyro_noise"),
        "b_acc_cov": _noise("params.imu.accel_bias_walk"),
        "b_gyr_cov": _noise("params.imu.gyro_bias_walk"),
        "fov_degree": nothing("the map is not cut to the field of view"),
        "det_range": same(
            "params.lidar.max_range", word="moves the cube, and drops farther points too", method=True
        ),
        "extrinsic_est_en": Rule(_estimated, method=True),
        "extrinsic_T": converted(
            "params.extrinsics.translation",
            by=lambda value, place: vector(value, place).tolist(),
            word="T_imu_lidar, as ours",
        ),
        "extrinsic_R": converted(
            "params.extrinsics.rotation",
            by=lambda value, place: quaternion(rotation(value, place)),
            word="as a quaternion x y z w; T_imu_lidar, as ours",
        ),
        "runtime_pos_log_enable": nothing(_OUTPUT),
        "map_file_path": nothing(_OUTPUT),
        "pcd_save_en": Rule(_saved),
        "interval": converted(
            "config.output.clouds_interval", by=_scans_per_file, word="0 for its -1: all scans in one file"
        ),
    },
    other_sections={"publish": nothing(_PUBLISHED)},
)
