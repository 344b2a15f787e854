"""``--params-from``: the recipe that is taken, the order of precedence, and the messages."""

import pytest
import yaml

from lio_jax.commands.run import resolve_settings
from tests.commands.conftest import PLAIN
from tests.data.foreign_files import FAST_LIO2_ROS2, LIO_SAM_ROS1


@pytest.fixture
def theirs(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text(LIO_SAM_ROS1)
    return path


def test_the_recipe_of_the_system_is_taken_unless_another_is_named(theirs, tmp_path):
    assert resolve_settings(None, (), theirs).recipe == "lio_sam"
    assert resolve_settings("default", (), theirs).recipe == "default"
    other = tmp_path / "fast.yaml"
    other.write_text(FAST_LIO2_ROS2)
    assert resolve_settings(None, (), other).recipe == "fast_lio2"
    assert resolve_settings(None, ()).recipe == "default"


def test_recipe_then_their_file_then_our_file_then_words(theirs, tmp_path):
    ours = tmp_path / "imu.yaml"
    ours.write_text("params: {imu: {gyro_noise: 0.5, accel_noise: 0.25}}")
    settings = resolve_settings(str(ours), ("params.imu.accel_noise=0.75",), theirs)
    assert settings.recipe == "lio_sam"
    assert settings.values["imu"]["gyro_noise"] == 0.5
    assert settings.values["imu"]["accel_noise"] == 0.75
    assert settings.values["imu"]["gravity"] == 9.80511
    assert settings.config.features.columns == 1800
    assert settings.config.registration.max_iterations == 30


def test_a_file_that_names_its_recipe_keeps_it(theirs, tmp_path):
    ours = tmp_path / "ours.yaml"
    ours.write_text("recipe: fast_lio2\nparams: {lidar: {max_range: 50}}")
    settings = resolve_settings(str(ours), (), theirs)
    assert settings.recipe == "fast_lio2"
    assert settings.values["lidar"]["max_range"] == 50.0
    assert settings.values["imu"]["gravity"] == 9.80511
    assert settings.values["map"]["voxel_size"] == 0.5


def test_the_mapping_is_printed(theirs, capfd):
    resolve_settings(None, ("params.imu.gravity=9.81",), theirs)
    lines = capfd.readouterr().err.splitlines()
    assert lines[0].endswith("LIO-SAM's parameters, recipe lio_sam")
    taken, left = lines[: lines.index("not taken:")], lines[lines.index("not taken:") :]

    def line_of(key, among):
        return next(line for line in among if line.split()[:1] == [key])

    assert "params.extrinsics.rotation=[0,1,0,0]  (inverted" in line_of("extrinsicRot", taken)
    assert "params.imu.gravity=9.80511 (replaced: 9.81)" in line_of("imuGravity", taken)
    assert line_of("z_tollerance", taken).endswith("1000 -> params.smoother.height_limit=1000")
    assert "replaced" not in line_of("imuAccNoise", taken)
    assert "T_world_imu" in line_of("extrinsicRPY", taken)
    assert "robot_localization" in line_of("gpsTopic", left)
    assert len(taken) - 1 + len(left) - 1 == len(yaml.safe_load(LIO_SAM_ROS1)["lio_sam"])


def test_a_recipe_that_takes_less_says_so(theirs, capfd):
    resolve_settings("default", (), theirs)
    said = capfd.readouterr().err
    assert "of LIO-SAM's method, not taken by the recipe default" in said


def test_a_run_takes_them(folder, cli, tmp_path, theirs):
    options = (
        "--recipe",
        "default",
        "--params-from",
        theirs,
        "--scans",
        1,
        *PLAIN,
        "config.output.map=false",
    )
    done = cli("run", folder, *options, "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert "imuGravity" in done.err
    values = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())
    assert values["params"]["imu"]["gravity"] == 9.80511
    assert values["params"]["extrinsics"]["rotation"] == pytest.approx([0, 1, 0, 0])


def test_a_wrong_file_ends_with_usage(folder, cli, tmp_path):
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("recipe: default")
    done = cli("run", folder, "--params-from", wrong, "--out", tmp_path / "out")
    assert done.status == 2
    assert f"{wrong}: holds no parameters" in done.err


def test_a_value_of_thousands_of_characters_is_cut_in_the_table(cli, theirs, tmp_path):
    theirs.write_text(theirs.read_text().replace("N_SCAN: 16", f"N_SCAN: 16\n  unknown: '{'9' * 5000}'"))
    done = cli("run", tmp_path / "nowhere", "--params-from", theirs, "--out", tmp_path / "out")
    (line,) = (line for line in done.err.splitlines() if "unknown" in line)
    assert len(line) < 400
