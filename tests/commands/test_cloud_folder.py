"""A simulated street as a folder of PCD files gives the poses of the recording that it was written from."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lio_jax.data.trajectory import read_tum
from tests.commands.conftest import PLAIN
from tests.data.cloud_files import write_pcd_folder
from tests.run.small_drive import COUNT, extrinsics, moving, write_folder


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    return write_pcd_folder(tmp_path_factory.mktemp("street") / "clouds", moving())


def test_a_street_of_files_is_tracked_as_the_recording_is(cli, clouds, tmp_path):
    # files state no duration: a scan ends with its last point
    native = write_folder(tmp_path / "native", [replace(s, duration=float(s.time.max())) for s in moving()])
    for data in (clouds, native):
        done = cli("run", data, "--out", tmp_path / f"out_{data.name}", *PLAIN, *extrinsics())
        assert done.status == 0, done.err
    found, expected = (read_tum(tmp_path / f"out_{name}" / "trajectory.tum") for name in ("clouds", "native"))
    assert len(found) == COUNT
    np.testing.assert_array_equal(found.stamp_ns, expected.stamp_ns)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-6)


def test_a_folder_of_clouds_is_inspected(cli, clouds):
    done = cli("inspect", clouds, "--json")
    assert done.status == 0, done.err
    found = json.loads(done.out)
    assert (found["format"], found["scans"]) == ("clouds", COUNT)
    assert "stamps: ns in the names of the files" in found["notes"]
    assert found["point_time"] is not None
