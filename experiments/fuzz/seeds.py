"""Small healthy inputs for the campaign: recordings in every format, poses, graphs, settings, a run."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from laspy import ExtraBytesParams, LasData, LasHeader
from pypcd4 import Encoding, PointCloud
from scipy.spatial.transform import Rotation

from experiments.fuzz.captures import write_captures
from lio_jax.data import write_native
from lio_jax.data.sequence import GpsData, ImuData, LidarScan
from lio_jax.data.trajectory import Trajectory, pose_matrices, write_kitti_poses, write_tum
from lio_jax.pose_graph.g2o import G2oEdge, write_g2o

Run = Callable[[list[str]], int]
"""Runs the command line with words and returns its exit status."""

START_NS = 1_700_000_000_000_000_000
_SCANS, _RINGS, _COLUMNS = 4, 16, 40
_SCAN_NS, _SAMPLE_NS = 100_000_000, 10_000_000

LIO_SAM = """
lio_sam:
  pointCloudTopic: "points_raw"
  imuTopic: "imu_raw"
  sensor: velodyne
  N_SCAN: 16
  Horizon_SCAN: 1800
  downsampleRate: 1
  lidarMinRange: 1.0
  lidarMaxRange: 1000.0
  imuAccNoise: 3.9939570888238808e-03
  imuGyrNoise: 1.5636343949698187e-03
  imuAccBiasN: 6.4356659353532566e-05
  imuGyrBiasN: 3.5640318696367613e-05
  imuGravity: 9.80511
  extrinsicTrans: [0.0, 0.0, 0.0]
  extrinsicRot: [-1, 0, 0, 0, 1, 0, 0, 0, -1]
  extrinsicRPY: [0, 1, 0, -1, 0, 0, 0, 0, 1]
  edgeThreshold: 1.0
  surfThreshold: 0.1
  odometrySurfLeafSize: 0.4
  mappingProcessInterval: 0.15
  loopClosureEnableFlag: true
  surroundingKeyframeSize: 50
  historyKeyframeSearchRadius: 15.0
"""

FAST_LIO = """
common:
    lid_topic:  "/livox/lidar"
    imu_topic:  "/livox/imu"
    time_offset_lidar_to_imu: 0.02
preprocess:
    lidar_type: 1
    scan_line: 6
    blind: 4
    timestamp_unit: 3
    scan_rate: 20
mapping:
    acc_cov: 0.1
    gyr_cov: 0.1
    b_acc_cov: 0.0001
    b_gyr_cov: 0.0001
    fov_degree:    90
    det_range:     450.0
    extrinsic_est_en:  false
    extrinsic_T: [ 0.04165, 0.02326, -0.0284 ]
    extrinsic_R: [ 1, 0, 0, 0, 1, 0, 0, 0, 1]
"""

SETTINGS = """
recipe: default
config:
  lidar: {buckets: [4096, 8192]}
  map: {capacity: 32768}
  data: {lidar_topic: /points, scan_period: 0.1}
params:
  map: {voxel_size: 0.8}
  imu: {gyro_noise: 0.003, accel_noise: 0.02}
  lidar: {min_range: 1.0, max_range: 80.0}
  extrinsics: {rotation: [0.0, 0.0, 0.0, 1.0], translation: [0.0, 0.0, 0.28]}
"""

SPEC = """
name: two voxel sizes
recipe: default
set:
  config.map.capacity: 32768
sequences:
  - {path: nowhere, start: 0, scans: 3}
seeds: [0, 1]
grid:
  params.map.voxel_size: [0.8, 1.2]
  params.registration.kernel: [0.1, 0.3]
baseline: {params.map.voxel_size: 1.2, params.registration.kernel: 0.1}
metrics: [ate.rmse, rpe.rmse]
"""


def write_seeds(root: Path, run: Run, with_run: bool) -> None:
    """Write all seeds below ``root``, one folder for each.

    Args:
        root: folder that does not exist yet.
        run: the command line, which converts the recording and makes the run.
        with_run: whether a run's folder is among the seeds; it takes a minute where nothing is compiled yet.

    Raises:
        RuntimeError: a command failed on a healthy file.
        LioJaxError: the library of Ouster captures is not installed.
    """

    def must(*words: object) -> None:
        if run([str(word) for word in words]):
            raise RuntimeError(f"failed on a healthy file: lio-jax {' '.join(map(str, words))}")

    # first, because it needs a library that may be missing
    write_captures(root / "captures", START_NS)
    native = root / "native" / "drive"
    write_native(
        native,
        [_scan(number) for number in range(_SCANS)],
        name="drive",
        sensor="16 rings",
        T_imu_lidar=pose_matrices(np.array([[0.0, 0.0, 0.3]]), np.array([[0.0, 0.0, 0.0, 1.0]]))[0],
        imu=_imu(80),
        gps=_gps(),
        truth=_truth(),
    )
    for folder, name, layout in (
        ("ros1", "a.bag", "velodyne"),
        ("livox", "a.bag", "livox"),
        ("ouster", "a.bag", "ouster"),
        ("mcap", "a.mcap", "velodyne"),
        ("sqlite", "a.db3", "velodyne"),
    ):
        out = root / folder / name
        must("export", native, "--to", "bag", "--layout", layout, "--out", out)
    turns = root / "parts" / "drive"
    write_native(turns, [part for number in range(_SCANS) for part in _fifths(_scan(number))], imu=_imu(80))
    must("export", turns, "--to", "bag", "--layout", "velodyne", "--out", root / "parts" / "a.bag")
    shutil.rmtree(turns)
    must("export", native, "--to", "kitti", "--out", root / "kitti" / "04")
    _write_kitti_raw(root / "kitti_raw" / "day")
    _write_clouds(root / "clouds")
    _write_texts(root)
    (root / "native" / "my.yaml").write_text(SETTINGS)
    (root / "rest").mkdir()
    still = _imu(4000)
    np.savez(root / "rest" / "imu.npz", stamp_ns=still.stamp_ns, gyro=still.gyro, accel=still.accel)
    # its programs are compiled before its time counts
    must("inspect", native, "--json")
    if with_run:
        # the back end writes keyframes and a corrected trajectory
        less = ("config.backend.loops=true", "config.output.recording=false", "config.output.plot=false")
        must("run", native, "--set", *less, "--out", root / "run" / "run")


def _scan(number: int) -> LidarScan:
    """Return a sweep in a room whose walls are 4 to 9 m away."""
    column, ring = (grid.ravel() for grid in np.meshgrid(np.arange(_COLUMNS), np.arange(_RINGS)))
    azimuth, elevation = -2 * np.pi * column / _COLUMNS, np.radians(2.0 * ring - 15.0)
    radius = 4.0 / np.maximum(np.abs(np.cos(azimuth)), 0.45) + 0.01 * number
    points = radius[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], -1)
    return LidarScan(
        START_NS + number * _SCAN_NS,
        points.astype(np.float32),
        (0.1 * column / _COLUMNS).astype(np.float32),
        ring.astype(np.int32),
        (column % 200).astype(np.float32),
        0.1,
    )


def _fifths(scan: LidarScan) -> Iterator[LidarScan]:
    """Yield five scans that hold a fifth of the sweep each, as a driver of small messages publishes them."""
    share = scan.duration / 5
    for number in range(5):
        kept = (scan.time * 5 // scan.duration).astype(int) == number
        yield LidarScan(
            scan.stamp_ns + round(number * share * 1e9),
            scan.points[kept],
            (scan.time[kept] - number * share).astype(np.float32),
            scan.ring[kept],
            scan.intensity[kept],
            share,
        )


def _imu(count: int) -> ImuData:
    rng = np.random.default_rng(0)
    stamps = START_NS - 20 * _SAMPLE_NS + np.arange(count) * _SAMPLE_NS
    gyro, accel = rng.normal(0, 1e-3, (2, count, 3))
    return ImuData(stamps, gyro, accel + np.array([0.0, 0.0, 9.81]))


def _gps() -> GpsData:
    rng = np.random.default_rng(1)
    stamps = START_NS + np.arange(5) * _SCAN_NS
    return GpsData(stamps, rng.normal(0, 0.1, (5, 3)), np.tile(np.eye(3), (5, 1, 1)), (48.1, 11.6, 520.0))


def _truth(count: int = 60) -> Trajectory:
    seconds = np.arange(count) * 0.01
    positions = np.stack([3 * seconds, np.sin(seconds), 0.1 * seconds], -1)
    turns = Rotation.from_rotvec(0.3 * seconds[:, None] * [0.0, 0.0, 1.0]).as_quat()
    return Trajectory(START_NS + np.arange(count) * _SAMPLE_NS, pose_matrices(positions, turns))


def _write_kitti_raw(day: Path) -> None:
    drive = day / "drive"
    data, oxts = drive / "velodyne_points" / "data", drive / "oxts" / "data"
    data.mkdir(parents=True)
    oxts.mkdir(parents=True)
    stamps = []
    for number in range(_SCANS):
        scan = _scan(number)
        rows = np.concatenate([scan.points, scan.intensity[:, None]], 1).astype(np.float32)
        if number == 1:
            np.savetxt(data / f"{number:010d}.txt", rows, fmt="%.3f")
        else:
            rows.tofile(data / f"{number:010d}.bin")
        packet = np.zeros(30)
        packet[:6] = (49.0 + 1e-6 * number, 8.4, 110.0, 0.01, 0.02, 0.3)
        packet[13], packet[23] = 9.81, 0.05
        (oxts / f"{number:010d}.txt").write_text(" ".join(f"{value:.9f}" for value in packet) + "\n")
        stamps.append(f"2011-09-26 13:02:{0.1 * number:012.9f}")
    ends = [f"2011-09-26 13:02:{0.1 * number + 0.1:012.9f}" for number in range(_SCANS)]
    for folder, name, lines in (
        (data.parent, "timestamps.txt", stamps),
        (data.parent, "timestamps_start.txt", stamps),
        (data.parent, "timestamps_end.txt", ends),
        (oxts.parent, "timestamps.txt", stamps),
    ):
        (folder / name).write_text("\n".join(lines) + "\n")
    (day / "calib_imu_to_velo.txt").write_text(
        "calib_time: 25-May-2012 16:47:16\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n"
    )


def _write_clouds(root: Path) -> None:
    """Write the scans as a folder of clouds in each format; text files lie beside those of ``text``."""
    for name in ("binary", "compressed", "text", "ply", "npy", "bin", "las"):
        (root / name).mkdir(parents=True)
    scans = [_scan(number) for number in range(_SCANS)]
    for scan in scans:
        columns = [*scan.points.T, scan.intensity, scan.time, scan.ring.astype(np.float32)]
        rows = np.stack(columns, axis=1).astype(np.float32)
        names = ("x", "y", "z", "intensity", "time", "ring")
        cloud = PointCloud.from_points(rows, names, (np.float32,) * 6)
        for name, encoding in (
            ("binary", Encoding.BINARY),
            ("compressed", Encoding.BINARY_COMPRESSED),
            ("text", Encoding.ASCII),
        ):
            cloud.save(root / name / f"{scan.stamp_ns}.pcd", encoding)
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        header += [*(f"property float {name}" for name in names), "end_header\n"]
        ply = "\n".join(header).encode() + rows.tobytes()
        (root / "ply" / f"{scan.stamp_ns}.ply").write_bytes(ply)
        np.save(root / "npy" / f"{scan.stamp_ns}.npy", rows[:, :4])
        rows[:, :4].tofile(root / "bin" / f"{scan.stamp_ns}.bin")
        _write_las(root / "las" / f"{scan.stamp_ns}.las", scan)
    seconds = "".join(f"{scan.stamp_ns / 1e9:.6f}\n" for scan in scans)
    (root / "text" / "times.txt").write_text(seconds)
    imu = _imu(80)
    lines = ["t,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"]
    for stamp_ns, gyro, accel in zip(imu.stamp_ns, imu.gyro, imu.accel, strict=True):
        lines.append(",".join(map(str, (stamp_ns, *gyro, *accel))))
    (root / "text" / "imu.csv").write_text("\n".join(lines) + "\n")
    write_tum(root / "text" / "truth.tum", _truth())


def _write_las(path: Path, scan: LidarScan) -> None:
    header = LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 1e-3)
    header.add_extra_dims([ExtraBytesParams("ring", "u2"), ExtraBytesParams("time", "f4")])
    las = LasData(header)
    las.xyz = scan.points
    las.intensity = scan.intensity
    las.gps_time = scan.stamp_ns * 1e-9 + scan.time
    las.ring, las.time = scan.ring, scan.time
    las.write(path)


def _write_texts(root: Path) -> None:
    truth = _truth(12)
    for name in ("poses", "graph", "settings", "spec", "foreign"):
        (root / name).mkdir()
    for name in ("estimate.tum", "reference.tum"):
        write_tum(root / "poses" / name, truth)
    for name in ("estimate.txt", "reference.txt"):
        write_kitti_poses(root / "poses" / name, truth.poses)
    seconds = "".join(f"{0.1 * number:.6f}\n" for number in range(len(truth)))
    (root / "poses" / "times.txt").write_text(seconds)
    edges = [_edge(truth.poses, first, first + 1) for first in range(5)]
    write_g2o(root / "graph" / "in.g2o", truth.poses[:6], [*edges, _edge(truth.poses, 0, 5)])
    lines = [f"VERTEX_SE2 {number} {number} 0 0.1" for number in range(4)]
    ends = [(0, 1), (1, 2), (2, 3), (0, 3)]
    lines += [f"EDGE_SE2 {first} {last} {last - first} 0 0 1 0 0 1 0 1" for first, last in ends]
    (root / "graph" / "plane.g2o").write_text("\n".join([*lines, "FIX 0"]) + "\n")
    (root / "settings" / "my.yaml").write_text(SETTINGS)
    (root / "spec" / "spec.yaml").write_text(SPEC)
    (root / "foreign" / "lio_sam.yaml").write_text(LIO_SAM)
    (root / "foreign" / "fast_lio.yaml").write_text(FAST_LIO)


def _edge(poses: np.ndarray, first: int, last: int) -> G2oEdge:
    return G2oEdge(first, last, np.linalg.inv(poses[first]) @ poses[last], np.eye(6))
