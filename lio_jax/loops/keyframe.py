"""What the back end keeps of a scan that stands for its surroundings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A pose of the odometry and what was seen there."""

    index: int
    """Its place among the keyframes."""
    stamp_ns: int
    """Of the scan's end."""
    T_odom_imu: NDArray[np.float64]
    """(4, 4) by the smooth odometry, z up."""
    points: NDArray[np.float32]
    """(n, 3) m, in the IMU frame at the stamp, thinned."""
    covariance: NDArray[np.float64]
    """(6, 6) of the pose's error since the keyframe before, right perturbation, rotation (rad) first."""
