"""Packet captures of a simulated drive run through ``lio-jax run`` and come near the truth."""

import json
from pathlib import Path

import pytest
from scipy.spatial.transform import Rotation

from lio_jax.data.trajectory import write_tum
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sensors import vlp16
from lio_jax.sim.sequence import SimulatedSequence
from tests.commands.conftest import PLAIN
from tests.data.captures import VLP16, received, same_timing, simulated_packets, write_pcap
from tests.data.ouster_captures import simulated, write_capture


def _metrics(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


def test_a_capture_of_a_moving_velodyne(cli, tmp_path):
    pytest.importorskip("velodyne_decoder", reason="velodyne-decoder is not installed: lio-jax[pcap]")
    drive = SimulatedSequence(
        sensor=same_timing(vlp16(), VLP16, 1800), duration_s=2.0, seed=1, moving_start=True
    )
    path = write_pcap(tmp_path / "drive.pcap", received(simulated_packets(VLP16, drive.lidar, drive.scans())))
    write_tum(tmp_path / "truth.tum", drive.truth())
    T = drive.info.T_imu_lidar
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    extrinsics = (
        f"params.extrinsics.rotation={quaternion}".replace(" ", ""),
        f"params.extrinsics.translation={T[:3, 3].tolist()}".replace(" ", ""),
    )
    done = cli("run", path, *PLAIN, *extrinsics, "--gt", tmp_path / "truth.tum", "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert "note: packets of a Velodyne VLP16" in done.err
    metrics = _metrics(tmp_path / "out")
    # sweeps of the simulation start behind, scans of the capture ahead: half a sweep at each end is left out
    assert 18 <= metrics["scans"] <= 20
    assert metrics["failures"] == metrics["warnings"] == []
    # measured: 0.023 m over 7.8 m, without inertial samples
    assert metrics["ate"]["rmse"] < 0.046


def test_a_capture_of_a_moving_ouster_with_its_imu(cli, tmp_path):
    pytest.importorskip("ouster.sdk", reason="ouster-sdk is not installed: pip install --no-deps ouster-sdk")
    drive = SimulatedSequence(sensor="os1_64", duration_s=2.0, seed=1, imu=ImuModel(), moving_start=True)
    path = write_capture(tmp_path / "drive.pcap", *simulated(drive))
    write_tum(tmp_path / "truth.tum", drive.truth())
    done = cli("run", path, *PLAIN, "--gt", tmp_path / "truth.tum", "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert "note: packets of an Ouster OS-1-64" in done.err
    assert "T_imu_lidar: from the recording's calibration." in done.err
    metrics = _metrics(tmp_path / "out")
    assert metrics["scans"] == 20
    assert metrics["failures"] == metrics["warnings"] == []
    # measured: 0.0021 m over 7.8 m
    assert metrics["ate"]["rmse"] < 0.005
    found = cli("inspect", path, "--json")
    assert found.status == 0, found.err
    seen = json.loads(found.out)
    assert (seen["format"], seen["scans"], seen["rings"]) == ("ouster_pcap", 20, 64)
    assert seen["imu_rate"] == pytest.approx(200.0)
    assert seen["problems"] == []
