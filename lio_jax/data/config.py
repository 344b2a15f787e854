"""How a recording is read."""

from dataclasses import dataclass
from typing import Literal

from lio_jax.core.leaf import static


@dataclass(frozen=True)
class DataConfig:
    """How a recording is read; "auto" or an empty string means that the value is recognised from the data and
    printed."""

    lidar_topic: str = static("")
    """Bag topic of the point clouds; empty: the one with most messages."""
    imu_topic: str = static("")
    """Bag topic of the inertial samples; empty: the one with most messages."""
    gps_topic: str = static("")
    """Bag topic used as GPS; empty: a NavSatFix, or an Odometry whose name holds gps, gnss or rtk."""
    time_field: str = static("")
    """Name of the per-point time field; empty: t, time, timestamp, time_stamp, offset_time or timeOffset."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = static("auto")
    """Unit of the per-point time field."""
    time_reference: Literal["auto", "relative", "absolute"] = static("auto")
    """Whether per-point times count from the scan or from the epoch."""
    stamp_at: Literal["auto", "start", "end"] = static("auto")
    """Which end of the scan the message's header stamp marks."""
    accel_unit: Literal["auto", "m/s^2", "g"] = static("auto")
    """Unit of the accelerometer."""
    length_unit: Literal["auto", "m", "mm"] = static("auto")
    """Unit of the points in a folder of clouds."""
    compensated: Literal["auto", "yes", "no"] = static("auto")
    """Whether the recording's points are already motion compensated (KITTI odometry: yes)."""
    vertical_correction_deg: float = static(0.205, "deg")
    """Correction of the HDL-64E's elevation angles, which is applied to the scans of KITTI alone."""
    messages_per_scan: int = static(0, least=0)
    """Number of a bag's messages that are joined to one scan; 0: 1, or as many as hold a turn of a spinning
    LiDAR whose messages hold parts of it."""
    beams: int = static(0, least=0)
    """Beams for ring reconstruction where the recording holds no ring; 0: 16, 32 or 64 by the data."""
    align_clocks: bool = static(False)
    """Shift the inertial samples of a bag once where their stamps differ by more than a second from those of
    the scans that were received with them. What is left of the difference is the delay of the messages."""
    scan_period: float = static(0.1, "s", above=0)
    """Duration of one sweep, and the time between scans that have no stamps, where it cannot be read from the
    data."""
    prefetch: int = static(3, least=0)
    """Number of scans decoded and padded ahead on a thread."""
