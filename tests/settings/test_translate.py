"""Parameter files of LIO-SAM and FAST-LIO2: the effect of each key, and the message for a wrong one."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import UsageError
from lio_jax.settings.settings import Settings, recipe_settings, settings_from_yaml, with_overrides
from lio_jax.settings.translate import ForeignSettings, foreign_settings_from_yaml, load_foreign_settings
from tests.data.foreign_files import FAST_LIO2_ROS1, FAST_LIO2_ROS2, LIO_SAM_ROS1, LIO_SAM_ROS2

IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1]


def read(text: str) -> ForeignSettings:
    return foreign_settings_from_yaml(text, "theirs.yaml")


def resolved(text: str, recipe: str = "") -> Settings:
    foreign = read(text)
    return foreign.applied_to(recipe_settings(recipe or foreign.system.recipe))


def lio_sam(**values: object) -> str:
    return yaml.safe_dump({"lio_sam": values})


def fast_lio2(**mapping: object) -> str:
    return yaml.safe_dump({"common": {"lid_topic": "/l"}, "preprocess": {"blind": 1}, "mapping": mapping})


def T_imu_lidar(settings: Settings) -> np.ndarray:
    extrinsics = settings.values["extrinsics"]
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_quat(extrinsics["rotation"]).as_matrix()
    transform[:3, 3] = extrinsics["translation"]
    return transform


FIXED_BY_LIO_SAM = {
    "extrinsics.rotation": [0, 1, 0, 0],
    "imu.gyro_noise": 1.5636343949698187e-03,
    "imu.accel_noise": 3.9939570888238808e-03,
    "imu.gyro_bias_walk": 3.5640318696367613e-05,
    "imu.accel_bias_walk": 6.4356659353532566e-05,
    "imu.gravity": 9.80511,
    "smoother.mapping_interval": 0.15,
}


@pytest.mark.parametrize("text", [LIO_SAM_ROS1, LIO_SAM_ROS2], ids=["ros1", "ros2"])
def test_lio_sams_defaults_are_the_recipes_but_for_what_the_file_fixes(text):
    settings = resolved(text)
    assert settings.recipe == "lio_sam"
    own = recipe_settings("lio_sam").as_dict()
    for section, leaves in settings.as_dict()["params"].items():
        for name, value in leaves.items():
            expected = FIXED_BY_LIO_SAM.get(f"{section}.{name}", own["params"][section][name])
            np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-12, err_msg=f"{section}.{name}")
    assert settings.run.data.lidar_topic == "points_raw"
    assert settings.run.data.imu_topic == "imu_raw"
    assert settings.run.data.gps_topic == ""
    assert not settings.run.backend.gps_elevation
    assert (settings.config.features.rings, settings.config.features.columns) == (16, 1800)
    assert settings.config.imu.heading
    assert not settings.config.imu.orientation


def test_every_key_of_both_systems_is_known():
    for text in (LIO_SAM_ROS1, LIO_SAM_ROS2, FAST_LIO2_ROS1, FAST_LIO2_ROS2):
        foreign = read(text)
        assert not [entry.key for entry in foreign.keys if "known here" in entry.word]
        assert all(entry.settings or entry.word for entry in foreign.keys)
    assert len(read(LIO_SAM_ROS1).keys) == len(read(LIO_SAM_ROS2).keys) == 54


def test_lio_sams_extrinsics_are_the_inverse_of_ours():
    R_lidar_imu = Rotation.from_euler("xyz", [0.3, -0.7, 2.1])
    t_lidar_imu = np.array([0.4, -0.2, 1.3])
    settings = resolved(
        lio_sam(extrinsicRot=R_lidar_imu.as_matrix().ravel().tolist(), extrinsicTrans=t_lidar_imu.tolist())
    )
    T_lidar_imu = np.eye(4)
    T_lidar_imu[:3, :3], T_lidar_imu[:3, 3] = R_lidar_imu.as_matrix(), t_lidar_imu
    np.testing.assert_allclose(T_imu_lidar(settings) @ T_lidar_imu, np.eye(4), atol=1e-12)


def test_lio_sams_numbers_for_kitti_place_the_velodyne_above_and_ahead_of_the_imu():
    rows = [9.999976e-01, 7.553071e-04, -2.035826e-03, -7.854027e-04, 9.998898e-01, -1.482298e-02]
    rows += [2.024406e-03, 1.482454e-02, 9.998881e-01]
    settings = resolved(
        lio_sam(extrinsicRot=rows, extrinsicTrans=[-8.086759e-01, 3.195559e-01, -7.997231e-01])
    )
    np.testing.assert_allclose(T_imu_lidar(settings)[:3, 3], [0.81, -0.31, 0.80], atol=0.02)


def test_fast_lio2s_extrinsics_are_ours():
    R_imu_lidar = Rotation.from_euler("zyx", [1.1, 0.2, -0.4])
    settings = resolved(
        fast_lio2(extrinsic_R=R_imu_lidar.as_matrix().ravel().tolist(), extrinsic_T=[0.1, -0.2, 0.3])
    )
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = R_imu_lidar.as_matrix(), [0.1, -0.2, 0.3]
    np.testing.assert_allclose(T_imu_lidar(settings), expected, atol=1e-12)


def test_a_file_with_three_digits_gives_the_nearest_rotation():
    turn = Rotation.from_euler("z", 0.3)
    rounded = np.round(turn.as_matrix(), 4)
    found = Rotation.from_quat(
        resolved(fast_lio2(extrinsic_R=rounded.tolist())).values["extrinsics"]["rotation"]
    )
    assert (found.inv() * turn).magnitude() < 1e-4


@pytest.mark.parametrize("inverted", [False, True])
def test_orientations_of_the_samples_axes_are_used_and_others_are_not(inverted):
    turn = Rotation.from_euler("z", 0.5)
    of_orientations = turn.inv() if inverted else turn
    matrices = {"extrinsicRot": turn, "extrinsicRPY": of_orientations}
    same = lio_sam(**{name: each.as_matrix().ravel().tolist() for name, each in matrices.items()})
    assert resolved(same).config.imu.orientation
    matrices["extrinsicRPY"] = of_orientations * Rotation.from_euler("x", 0.1)
    other = lio_sam(**{name: each.as_matrix().ravel().tolist() for name, each in matrices.items()})
    assert not resolved(other).config.imu.orientation


def test_fast_lio2s_values():
    settings = resolved(FAST_LIO2_ROS1)
    own = recipe_settings("fast_lio2")
    assert settings.values["imu"] == pytest.approx(own.values["imu"], rel=1e-12)
    assert settings.values["lidar"]["min_range"] == 4.0
    assert settings.values["lidar"]["max_range"] == 450.0
    assert settings.values["extrinsics"]["time_offset"] == 0.02
    assert settings.values["initial"]["extrinsic_rotation_sigma"] == 0.0
    assert settings.values["initial"]["extrinsic_translation_sigma"] == 0.0
    assert settings.run.data.lidar_topic == "/livox/lidar"
    assert settings.run.data.scan_period == 0.05
    assert settings.run.data.time_unit == "auto"


def test_fast_lio2s_values_for_ros2():
    settings = resolved(FAST_LIO2_ROS2)
    own = recipe_settings("fast_lio2")
    for section in ("imu", "initial", "map", "registration", "point_map"):
        for name, value in own.values[section].items():
            assert settings.values[section][name] == pytest.approx(value, rel=1e-12), (section, name)
    assert settings.run.data.time_unit == "ns"
    assert settings.config.fast_lio2.point_filter_num == 3
    assert settings.config.registration.max_iterations == 4


def test_a_density_grows_as_the_root_of_the_covariance():
    """cov dt^2 a step is density^2 dt: both make the same variance of a velocity after a second."""
    settings = resolved(fast_lio2(acc_cov=0.4))
    rate = 200
    variance = sum(0.4 / rate**2 for _ in range(rate))
    assert settings.values["imu"]["accel_noise"] ** 2 == pytest.approx(variance, rel=1e-12)


def test_another_recipe_takes_the_sensors_facts_alone():
    settings = resolved(LIO_SAM_ROS1, "default")
    own = recipe_settings("default")
    assert settings.values["imu"]["gyro_noise"] == 1.5636343949698187e-03
    assert settings.values["extrinsics"]["rotation"] == pytest.approx([0, 1, 0, 0])
    assert settings.values["map"] == own.values["map"]
    assert settings.values["registration"] == own.values["registration"]
    assert settings.config == own.config


@pytest.mark.parametrize("text", [LIO_SAM_ROS1, LIO_SAM_ROS2, FAST_LIO2_ROS1, FAST_LIO2_ROS2])
def test_what_is_mapped_can_be_overridden_and_written_and_read(text):
    settings = with_overrides(resolved(text), ["params.lidar.max_range=77"])
    assert settings.values["lidar"]["max_range"] == 77.0
    settings.params()
    assert settings_from_yaml(settings.to_yaml(), "config.yaml").as_dict() == settings.as_dict()


def test_lio_sams_thresholds_of_gps():
    theirs = lio_sam(useGpsElevation=True, gpsCovThreshold=3.5, poseCovThreshold=9.0)
    settings = resolved(theirs)
    assert settings.run.backend.gps_elevation
    assert (settings.values["gps"]["max_variance"], settings.values["gps"]["pose_variance"]) == (3.5, 9.0)
    assert not settings.run.backend.gps
    assert resolved(theirs, "default").values["gps"] == recipe_settings("default").values["gps"]


def test_numbers_that_yaml_reads_as_text():
    assert resolved("lio_sam: {imuAccNoise: 1e-3}").values["imu"]["accel_noise"] == 1e-3
    assert resolved(fast_lio2(acc_cov="2e-1")).values["imu"]["accel_noise"] == pytest.approx(1e-3**0.5)


def test_a_livoxs_rings_follow_their_points():
    assert resolved(lio_sam(sensor="livox")).config.features.order == "arrival"
    assert resolved(lio_sam(sensor="ouster")).config.features.order == "azimuth"


SCALED = (1.1 * np.eye(3)).ravel().tolist()
MIRROR = [-1, 0, 0, 0, 1, 0, 0, 0, 1]

WRONG = {
    "another file": ("recipe: default", ["holds no parameters of LIO-SAM or FAST-LIO2", "--recipe"]),
    "no names": ("- 1\n- 2", ["expected parameters by name"]),
    "not YAML": ("lio_sam: [1, 2", ["not valid YAML"]),
    "OpenCV": ("%YAML:1.0\nT: !!opencv-matrix\n  rows: 3", ["OpenCV", "plain lists"]),
    "no section": ("imuTopic: imu_raw", ["'lio_sam:'", "'ros__parameters:'", "missing"]),
    "empty section": ("lio_sam:", ["lio_sam = None", "must hold parameters"]),
    "no mapping": ("common: {lid_topic: /l}\npreprocess: {blind: 1}", ["'mapping' is missing"]),
    "text": ("lio_sam: {imuAccNoise: much}", ["imuAccNoise", "'much'", "must be a number"]),
    "null": ("lio_sam: {lidarMinRange: }", ["lidarMinRange", "must be a number"]),
    "half a ring": ("lio_sam: {N_SCAN: 16.5}", ["N_SCAN", "must be a whole number"]),
    "range": ("lio_sam: {lidarMinRange: 9, lidarMaxRange: 5}", ["min_range", "must be below"]),
    "short": (lio_sam(extrinsicRot=[1, 0, 0]), ["extrinsicRot", "a list of 9 numbers"]),
    "word inside": (lio_sam(extrinsicRot=["x", *IDENTITY[1:]]), ["extrinsicRot, number 1", "'x'"]),
    "translation": (
        lio_sam(extrinsicRot=IDENTITY, extrinsicTrans=[1, 2]),
        ["extrinsicTrans", "a list of 3 numbers"],
    ),
    "lonely": (lio_sam(extrinsicTrans=[0, 0, 0]), ["extrinsicTrans", "without extrinsicRot"]),
    "scaled": (
        lio_sam(extrinsicRot=SCALED),
        ["extrinsicRot is not a rotation", "determinant is 1.331", "nearest rotation is [1.0, 0.0"],
    ),
    "mirror": (lio_sam(extrinsicRot=MIRROR), ["extrinsicRot", "determinant is -1", "mirrors"]),
    "flat": (lio_sam(extrinsicRot=[0] * 9), ["extrinsicRot", "determinant is 0", "perpendicular"]),
    "unit": (
        FAST_LIO2_ROS2.replace("timestamp_unit: 3", "timestamp_unit: 7"),
        ["preprocess.timestamp_unit", "7", "3 (ns)"],
    ),
    "negative": (fast_lio2(gyr_cov=-1), ["mapping.gyr_cov", "greater than zero"]),
    "a word for a flag": (fast_lio2(extrinsic_est_en="maybe"), ["extrinsic_est_en", "true or false"]),
    "rate": (FAST_LIO2_ROS1.replace("scan_rate: 20", "scan_rate: 0"), ["scan_rate", "greater than zero"]),
}


@pytest.mark.parametrize("case", WRONG)
def test_an_error_is_a_sentence_with_file_and_key(case):
    text, words = WRONG[case]
    with pytest.raises(UsageError) as raised:
        resolved(text)
    sentence = str(raised.value)
    assert sentence.startswith("theirs.yaml")
    assert sentence.endswith(".")
    assert "\n" not in sentence
    for word in words:
        assert word in sentence


def test_a_file_that_is_not_there_or_not_text(tmp_path):
    with pytest.raises(UsageError, match=r"none\.yaml: the parameter file cannot be read"):
        load_foreign_settings(tmp_path / "none.yaml")
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="is not a text file"):
        load_foreign_settings(tmp_path / "bytes.yaml")


@pytest.mark.parametrize(
    ("saved", "interval", "clouds", "scans"),
    [(True, -1, "all", 0), (True, 10, "all", 10), (True, 0, "all", 0), (False, 5, "none", 5)],
)
def test_fast_lio2s_saved_clouds_are_the_runs(saved, interval, clouds, scans):
    values = yaml.safe_load(fast_lio2(max_iteration=3))
    values |= {"pcd_save": {"pcd_save_en": saved, "interval": interval}}
    # what is published there does not choose what is saved
    values |= {"publish": {"scan_publish_en": not saved, "dense_publish_en": False}}
    for recipe in ("fast_lio2", "default"):
        output = resolved(yaml.safe_dump(values), recipe).run.output
        assert (output.clouds, output.clouds_interval) == (clouds, scans)


def test_wrong_values_of_the_saved_clouds_are_named():
    values = yaml.safe_load(fast_lio2(max_iteration=3))
    with pytest.raises(UsageError, match=r"theirs\.yaml: pcd_save\.pcd_save_en = 1 must be true or false\."):
        read(yaml.safe_dump(values | {"pcd_save": {"pcd_save_en": 1}}))
    with pytest.raises(UsageError, match=r"pcd_save\.interval = 1\.5 must be a whole number\."):
        read(yaml.safe_dump(values | {"pcd_save": {"interval": 1.5}}))


@pytest.mark.parametrize("wanted", [True, False])
def test_fast_lio2s_clock_alignment_is_the_readers(wanted):
    values = yaml.safe_load(fast_lio2(max_iteration=3))
    values["common"]["time_sync_en"] = wanted
    assert resolved(yaml.safe_dump(values)).run.data.align_clocks is wanted


@pytest.mark.parametrize("key", ["mappingCornerLeafSize", "mappingSurfLeafSize"])
def test_a_lio_sam_file_asks_for_the_means_of_voxel_grid(key):
    assert resolved(lio_sam(N_SCAN=16, **{key: 0.3})).config.lio_sam.map_points == "mean"
