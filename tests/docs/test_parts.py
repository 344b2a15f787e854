"""The examples of the page of parts, against what is known of their scenes."""

import re
import runpy
from pathlib import Path

import jax
import numpy as np
import pytest

PARTS = Path(__file__).parents[2] / "docs" / "parts"


@pytest.fixture
def ran():
    """Return a function that runs an example and returns its names; the precision is reset afterwards."""
    before = jax.config.jax_enable_x64
    yield lambda name: runpy.run_path(str(PARTS / f"{name}.py"))
    jax.config.update("jax_enable_x64", before)


def test_the_page_shows_every_example():
    shown = re.findall(r'--8<-- "docs/parts/(\w+)\.py"', (PARTS.parent / "parts.md").read_text())
    assert sorted(shown) == sorted(path.stem for path in PARTS.glob("*.py"))


def test_preintegration_follows_the_circle(ran):
    end = ran("preintegration")["end"]
    on_circle = [4 * np.sin(0.5), 4 * (1 - np.cos(0.5)), 0.0]
    np.testing.assert_allclose(end.T_world_imu.translation(), on_circle, atol=1e-9)
    np.testing.assert_allclose(end.velocity, [2 * np.cos(0.5), 2 * np.sin(0.5), 0.0], atol=1e-9)


def test_deskewing_gathers_the_post(ran):
    found = ran("deskewing")
    assert np.ptp(found["seen"], axis=0).max() > 1.0
    assert np.ptp(found["compensated"], axis=0).max() < 1e-9


def test_features_fill_their_clouds(ran):
    features = ran("features")["features"]
    counts = [int(cloud.mask.sum()) for cloud in (features.sharp, features.less_sharp, features.less_flat)]
    assert 0 < counts[0] < counts[1] < counts[2]


def test_the_map_knows_the_slope(ran):
    planes = ran("voxel_map")["planes"]
    assert planes.valid.all()
    upwards = planes.normal * np.sign(planes.normal[:, 2:])
    np.testing.assert_allclose(upwards, np.tile([-0.1, 0.0, 1.0] / np.sqrt(1.01), (100, 1)), atol=1e-3)


@pytest.mark.long
def test_smoothing_lowers_the_error_as_its_covariance_says(ran):
    found = ran("smoother")
    result, place = found["result"], found["place"]
    assert int(result.status) == 0
    before = np.linalg.norm(found["measured"].translation() - place, axis=1)
    after = np.asarray(result.states.T_world_imu.translation() - place)
    assert np.linalg.norm(after, axis=1).mean() < 0.5 * before.mean()
    sigma = np.sqrt([np.diag(covariance)[3:6] for covariance in result.covariances()])
    # the errors of one recording are correlated: its 63 coordinates are worth a few independent ones
    assert 0.3 < np.mean((after / sigma) ** 2) < 3.0


@pytest.mark.long
def test_the_derivative_of_the_pose_graph_is_the_difference(ran):
    found = ran("pose_graph")
    end, step = found["end"], 1e-4
    assert np.linalg.norm(end(0.1)) < 0.1 * np.linalg.norm(found["poses"][-1].translation())
    expected = (np.asarray(end(0.1 + step)) - np.asarray(end(0.1 - step))) / (2 * step)
    np.testing.assert_allclose(jax.jacobian(end)(0.1), expected, rtol=1e-4, atol=1e-8)
