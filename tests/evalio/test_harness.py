"""The recipes in evalio's harness, and the simulated worlds as its datasets."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("evalio", reason="evalio is not installed; it comes with lio-jax[dev]")

from evalio import datasets, pipelines, stats
from evalio._cpp.types import VisOption
from evalio.types import ImuMeasurement, Trajectory

import lio_jax
import lio_jax.evalio
from lio_jax.core.errors import LioJaxError
from lio_jax.data import open_sequence
from lio_jax.data.evalio_points import scan_of
from lio_jax.evalio.datasets import (
    SENSOR_SHAPES,
    WORLD_DATASETS,
    measurement_of,
    simulated,
    write_sequence,
)
from lio_jax.evalio.pipelines import LioJaxDefault, LioJaxLoam
from lio_jax.recipes import RECIPES
from lio_jax.run.run import imu_feed
from lio_jax.run.track import track
from lio_jax.sim.sensors import SENSORS
from lio_jax.sim.sequence import WORLDS

ROOT = Path(lio_jax.__file__).parents[1]
SCANS = 50
NAME = "lio_jax_street/generic16_0"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder of evalio's data with five seconds of a street."""
    folder = tmp_path_factory.mktemp("evalio_data")
    write_sequence(folder / NAME, simulated("street", "generic16", 0, duration_s=SCANS / 10))
    return folder


@pytest.fixture
def street(data, monkeypatch):
    """The dataset of that folder."""
    monkeypatch.setattr("evalio.datasets.base._DATA_DIR", data)
    return WORLD_DATASETS["street"]("generic16_0")


def evalio(data: Path, *words: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"EVALIO_CUSTOM": "lio_jax.evalio", "EVALIO_DATA": str(data), "COLUMNS": "300"}
    return subprocess.run(
        [sys.executable, "-c", "from evalio.cli import app; app()", *words],
        capture_output=True,
        text=True,
        env=environment,
        cwd=ROOT,
        timeout=900,
        check=False,
    )


@pytest.mark.long
def test_a_run_of_evalio_is_complete_and_near_the_truth(data, street):
    out = data / "results"
    done = evalio(data, "run", "-d", NAME, "-p", "lio_jax_default", "-p", "kiss", "-o", str(out))
    assert done.returncode == 0, done.stderr
    truth = Trajectory.from_file(out / NAME / "gt.csv")
    errors = {}
    for system in ("lio_jax_default", "kiss"):
        estimate = Trajectory.from_file(out / NAME / f"{system}.csv")
        assert estimate.metadata.status.value == "complete", done.stderr
        assert len(estimate) == SCANS
        errors[system] = stats.ate(estimate, truth).sse().trans
    assert errors["lio_jax_default"] < 0.05
    # another system's result shows that the measurements and the truth belong together
    assert errors["kiss"] < 1.0


@pytest.mark.long
def test_a_pipeline_gives_the_poses_of_a_run_to_the_bit(street):
    pipe = LioJaxDefault()
    pipe.set_params(pipe.default_params())
    pipe.set_imu_params(street.imu_params())
    pipe.set_lidar_params(street.lidar_params())
    pipe.set_imu_T_lidar(street.imu_T_lidar())
    pipe.initialize()
    pipe.set_visualizing({VisOption.MAP, VisOption.FEATURES})
    # evalio asks for the map before the first scan
    assert pipe.map() == {"map": []}
    estimates, features, maps = [], [], []
    for measured in street:
        if isinstance(measured, ImuMeasurement):
            pipe.add_imu(measured)
        else:
            pipe.add_lidar(measured)
        estimates += pipe.saved_estimates()
        features += pipe.saved_features_matrix()
        maps += pipe.saved_maps_matrix()
    sequence = open_sequence(street.folder)
    settings = pipe._odometry.settings
    read = list(track(settings, sequence.scans(), imu_feed(sequence, settings)[0]))
    assert [stamp.to_nsec() for stamp, _ in estimates] == [one.stamp_ns for one in read]
    for (_, pose), one in zip(estimates, read, strict=True):
        np.testing.assert_allclose(pose.to_mat(), one.T_world_imu, rtol=0, atol=1e-12)
    assert len(features) == SCANS
    seen = features[-1][1]["points"]
    assert len(seen) > 100
    # the ground, in the lidar's frame
    assert -3 < np.percentile(seen[:, 2], 5) < 0
    assert len(maps) == SCANS
    assert len(maps[-1][1]["map"]) > len(maps[0][1]["map"]) > 100


def test_evalio_finds_pipelines_and_datasets_by_name(data):
    listed = evalio(data, "ls", "pipelines", "-q")
    assert listed.returncode == 0, listed.stderr
    for recipe in RECIPES:
        assert f"lio_jax_{recipe}" in listed.stdout
    listed = evalio(data, "ls", "datasets", "-q")
    assert listed.returncode == 0, listed.stderr
    for world in WORLDS:
        assert f"lio_jax_{world}" in listed.stdout


def test_every_recipe_and_world_is_registered():
    names = {f"lio_jax_{recipe}" for recipe in RECIPES}
    assert {name for name in pipelines.all_pipelines() if name.startswith("lio_jax")} == names
    worlds = {f"lio_jax_{world}" for world in WORLDS}
    assert {name for name in datasets.all_datasets() if name.startswith("lio_jax")} == worlds


def test_before_initialisation_jax_is_not_started():
    code = (
        "import lio_jax.evalio as e; from jax._src import xla_bridge; p = e.LioJaxDefault();"
        "p.set_params(p.default_params()); d = e.LioJaxCity('os1_64_1'); d.lidar_params(); d.imu_T_lidar();"
        "assert not xla_bridge._backends"
    )
    # evalio forks, which a process that runs JAX does not survive
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_parameters_are_paths_and_unknown_ones_are_handed_back():
    pipe = LioJaxDefault()
    assert pipe.set_params({"params.map.voxel_size": 0.7, "voxel_size": 1.0}) == {"voxel_size": 1.0}
    assert pipelines.validate_params(LioJaxDefault, {"params.map.voxel_size": 0.7}) is None
    assert not any(path.startswith("params.extrinsics") for path in pipe.default_params())
    assert not any(path.startswith("params.imu") for path in LioJaxLoam.default_params())


def test_settings_are_fitted_to_the_calibration(street):
    pipe = LioJaxDefault()
    pipe.set_params(pipe.default_params() | {"params.map.voxel_size": 0.7})
    pipe.set_imu_params(street.imu_params())
    pipe.set_lidar_params(street.lidar_params())
    scan = next(open_sequence(street.folder).scans())
    settings = pipe._fitted(scan)
    assert settings.values["map"]["voxel_size"] == 0.7
    assert settings.values["imu"]["gyro_noise"] == pytest.approx(1.5 * 0.003 / np.sqrt(200))
    assert settings.values["lidar"]["max_range"] == 100.0
    # the recipe's own, since the sensor's least range is below
    assert settings.values["lidar"]["min_range"] == 2.0
    assert settings.config.lidar.buckets == (8192,)


@pytest.mark.parametrize("sensor", SENSOR_SHAPES)
def test_sensors_are_stated_as_they_are_simulated(sensor):
    shape = SENSOR_SHAPES[sensor]
    if shape.sensor:
        return
    lidar = SENSORS[sensor].build()
    assert (shape.rows, shape.columns) == (lidar.beams, lidar.columns)
    assert shape.min_range == pytest.approx(float(lidar.ranging.minimum))
    assert shape.max_range == pytest.approx(float(lidar.ranging.maximum))
    # the column follows from a point's time
    assert max(lidar.delay_ns) < lidar.period_ns // lidar.columns
    assert set(SENSORS) < set(SENSOR_SHAPES)


def test_a_scan_comes_back_from_evalio_as_it_was(street):
    shape = SENSOR_SHAPES["generic16"]
    scan = next(open_sequence(street.folder).scans())
    measured = measurement_of(scan, shape)
    assert len(measured.points) == shape.rows * shape.columns
    assert [point.col for point in measured.points[: shape.columns]] == list(range(shape.columns))
    back = scan_of(measured, rate=10.0)
    np.testing.assert_array_equal(back.points, scan.points)
    np.testing.assert_array_equal(back.ring, scan.ring)
    np.testing.assert_allclose(back.time, scan.time, atol=2e-9)
    assert (back.stamp_ns, back.duration) == (scan.stamp_ns, scan.duration)


def test_a_scan_arrives_behind_the_samples_that_cover_it(street):
    newest = 0
    for measured in street:
        if isinstance(measured, ImuMeasurement):
            newest = measured.stamp.to_nsec()
        else:
            assert newest >= measured.stamp.to_nsec() + 100_000_000


def test_a_sequence_is_there_once_it_is_simulated(street):
    assert street.is_downloaded()
    assert len(street) == SCANS
    assert not WORLD_DATASETS["street"]("generic16_1").is_downloaded()
    truth = street.ground_truth()
    assert len(truth) == 10 * SCANS + 1


def test_a_sequence_of_evalio_is_a_recording(street):
    read, own = open_sequence(f"evalio:{NAME}"), open_sequence(street.folder)
    assert read.info.format == "evalio"
    assert read.info.scan_count == SCANS
    np.testing.assert_allclose(read.info.T_imu_lidar, own.info.T_imu_lidar, atol=1e-12)
    scan, expected = next(read.scans(7, 1)), next(own.scans(7, 1))
    assert (scan.stamp_ns, scan.duration) == (expected.stamp_ns, expected.duration)
    np.testing.assert_array_equal(scan.points, expected.points)
    assert len(list(read.scans(SCANS - 2, 5))) == 2
    for name in ("stamp_ns", "gyro", "accel"):
        np.testing.assert_array_equal(getattr(read.imu(), name), getattr(own.imu(), name))
    np.testing.assert_array_equal(read.truth().stamp_ns, own.truth().stamp_ns)
    np.testing.assert_allclose(read.truth().poses, own.truth().poses, atol=1e-9)
    assert read.gps() is None


@pytest.mark.parametrize(
    ("name", "words"),
    [("lio_jax_street/nothing", "knows no such sequence"), ("lio_jax_street/livox_2", "evalio dl lio_jax")],
)
def test_a_sequence_that_is_not_there_is_named(name, words, street):
    with pytest.raises(LioJaxError, match=words):
        open_sequence(f"evalio:{name}")


def test_without_evalio_one_sentence_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "evalio", None)
    with pytest.raises(LioJaxError, match="evalio is not installed; install it"):
        open_sequence("evalio:newer_college_2020/short_experiment")
    monkeypatch.delitem(sys.modules, "lio_jax.evalio")
    with pytest.raises(ImportError, match="needs evalio"):
        importlib.import_module("lio_jax.evalio")
