"""Captures of an Ouster in a box: metadata and lidar packets by the vendor's library, inertial ones by hand.

Sources: Ouster, "Firmware User Manual", sections "Lidar Range to XYZ" and "IMU Data Packet Format".
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.lidar import SpinningLidar
from lio_jax.sim.sequence import SimulatedSequence
from tests.data.captures import HALF, START_NS, Sent, write_pcap

LIDAR_PORT, IMU_PORT = 7502, 7503
PERIOD_NS = 100_000_000
COLUMNS = 1024
LIDAR_ABOVE_SENSOR = 0.03618
"""Height of the lidar frame in the sensor's frame, m: lidar_to_sensor_transform."""


def metadata(profile: str = "LEGACY", **ports: int) -> dict[str, Any]:
    """Return the metadata of an OS1-64 as its library writes it."""
    from ouster.sdk import core

    described = json.loads(core.SensorInfo.from_default(core.LidarMode._1024x10).to_json_string())
    # without ports the library reads no packet
    described["config_params"] |= {"udp_port_lidar": LIDAR_PORT, "udp_port_imu": IMU_PORT} | ports
    described["lidar_data_format"]["udp_profile_lidar"] = profile
    return described


def box_ranges(described: dict[str, Any], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ranges that the sensor measures in a box around its own origin, (beams, columns) m."""
    beams = described["beam_intrinsics"]
    altitude = np.radians(beams["beam_altitude_angles"])[:, None]
    azimuth = -np.radians(beams["beam_azimuth_angles"])[:, None]
    origin_m = beams["lidar_origin_to_beam_origin_mm"] * 1e-3
    encoder = 2 * np.pi * (1 - np.arange(COLUMNS) / COLUMNS)
    ways = np.stack(
        [
            -np.cos(encoder + azimuth) * np.cos(altitude),
            -np.sin(encoder + azimuth) * np.cos(altitude),
            np.sin(altitude) + 0 * encoder,
        ],
        axis=-1,
    )
    origin = np.stack(
        [-origin_m * np.cos(encoder), -origin_m * np.sin(encoder), LIDAR_ABOVE_SENSOR + 0 * encoder], axis=-1
    )
    return ((np.copysign(half, ways) - origin) / ways).min(axis=-1) + origin_m


def lidar_packets(
    described: dict[str, Any], ranges: NDArray[np.float64], number: int, signal: int = 77
) -> list[Sent]:
    """Return the packets of one frame; a range of 0 is no return."""
    from ouster.sdk import core

    info = core.SensorInfo(json.dumps(described))
    frame = core.LidarFrame(info)
    frame.frame_id = number + 1
    frame.field("RANGE")[:] = np.rint(ranges * 1000)
    frame.field("SIGNAL" if "SIGNAL" in frame.fields else "REFLECTIVITY")[:] = signal
    frame.status[:] = 1
    frame.measurement_id[:] = np.arange(COLUMNS)
    frame.timestamp[:] = START_NS + number * PERIOD_NS + np.arange(COLUMNS) * PERIOD_NS // COLUMNS
    if "IMU_ACC" in frame.fields:
        samples = len(frame.field("IMU_STATUS"))
        at = np.arange(samples) * PERIOD_NS // samples
        frame.field("IMU_TIMESTAMP")[:] = START_NS + number * PERIOD_NS + at
        frame.field("IMU_PACKET_TIMESTAMP")[:] = START_NS + number * PERIOD_NS + 1
        frame.field("IMU_MEASUREMENT_ID")[:] = np.arange(samples) * (COLUMNS // samples)
        frame.field("IMU_ACC")[:] = [0.5, -1.5, 9.75]
        frame.field("IMU_GYRO")[:] = [0.25, -0.5, 1.0]
        # one sample of each frame was not measured
        frame.field("IMU_STATUS")[:] = np.arange(samples) != 5
    packets = core.frame_to_packets(frame, core.PacketFormat(info), info.init_id, info.sn)
    step_ns = PERIOD_NS // len(packets)
    begin_ns = START_NS + number * PERIOD_NS + 3_000_000
    return [
        Sent(
            begin_ns + place * step_ns,
            IMU_PORT if isinstance(packet, core.ImuPacket) else LIDAR_PORT,
            packet.buf.tobytes(),
        )
        for place, packet in enumerate(packets)
    ]


def simulated(drive: SimulatedSequence) -> tuple[dict[str, Any], list[Sent]]:
    """Return metadata and packets of a simulated OS1-64 with its IMU."""
    assert isinstance(drive.lidar, SpinningLidar)
    described, T_imu_lidar = metadata(), drive.info.T_imu_lidar
    assert T_imu_lidar is not None
    beams = described["beam_intrinsics"]
    # an Ouster counts azimuths clockwise
    beams["beam_azimuth_angles"] = (-np.degrees(drive.lidar.azimuth)).tolist()
    beams["beam_altitude_angles"] = np.degrees(drive.lidar.elevation).tolist()
    # the simulated rays start at the sensor's origin
    beams["lidar_origin_to_beam_origin_mm"] = 0.0
    beams["beam_to_lidar_transform"] = np.eye(4).ravel().tolist()
    described["lidar_intrinsics"]["lidar_to_sensor_transform"] = np.diag([-1.0, -1, 1, 1]).ravel().tolist()
    T_lidar_imu = np.linalg.inv(T_imu_lidar)
    T_lidar_imu[:3, 3] *= 1000
    described["imu_intrinsics"]["imu_to_sensor_transform"] = T_lidar_imu.ravel().tolist()
    sent = []
    for number, scan in enumerate(drive.scans()):
        ranges = np.zeros((64, COLUMNS))
        column = np.rint(scan.time.astype(np.float64) * 1e9 / PERIOD_NS * COLUMNS).astype(int)
        ranges[scan.ring, column] = np.linalg.norm(scan.points.astype(np.float64), axis=1)
        sent += lidar_packets(described, ranges, number)
    imu = drive.imu()
    assert imu is not None
    for stamp_ns, gyro, accel in zip(imu.stamp_ns, imu.gyro, imu.accel, strict=True):
        sent.append(imu_packet(int(stamp_ns), (accel / 9.80665).tolist(), np.degrees(gyro).tolist()))
    return described, sent


def frames(number: int = 4, profile: str = "LEGACY") -> tuple[dict[str, Any], list[Sent]]:
    """Return metadata and packets of a sensor that stands in the box."""
    described = metadata(profile)
    ranges = box_ranges(described, HALF)
    return described, [one for frame in range(number) for one in lidar_packets(described, ranges, frame)]


def imu_packet(stamp_ns: int, accel_g: list[float], gyro_deg: list[float]) -> Sent:
    """Return the packet of one sample: three times in ns, then g and deg/s."""
    data = struct.pack("<QQQ6f", stamp_ns - 5, stamp_ns - 3, stamp_ns, *accel_g, *gyro_deg)
    return Sent(stamp_ns + 1_000_000, IMU_PORT, data)


def write_capture(path: Path, described: dict[str, Any] | None, sent: list[Sent], **options: Any) -> Path:
    """Write a capture with its metadata beside it, packets in the order of their receipt."""
    if described is not None:
        path.with_suffix(".json").write_text(json.dumps(described))
    return write_pcap(path, sorted(sent, key=lambda one: one.received_ns), **options)
