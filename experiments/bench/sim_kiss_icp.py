"""Track a simulated bag with KISS-ICP through its own bag reader: other systems can use our recordings.

    python experiments/bench/sim_kiss_icp.py [--bag BAG] [--world city] [--sensor vlp16] [--duration 60]

Without ``--bag`` a bag is simulated first, ROS 1 with the driver's layout. Prints the absolute trajectory
error of the sensor, aligned over the whole drive, and its share of the path. Needs ``pip install
lio-jax[bench]``.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.cli import main as lio_jax
from lio_jax.commands.sim import truth_beside
from lio_jax.data.config import DataConfig
from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.trajectory import Trajectory, read_tum
from lio_jax.evaluation.association import match_by_time
from lio_jax.evaluation.trajectory_error import absolute_error, align


def main() -> None:
    """Track one bag and print the errors."""
    options = _options()
    with tempfile.TemporaryDirectory() as folder:
        bag = options.bag or _simulated(Path(folder) / "simulated.bag", options)
        estimate = _tracked(bag)
        poses, arrays = truth_beside(bag)
        truth = read_tum(poses).times_body(np.load(arrays)["T_imu_lidar"])
    matched = match_by_time(estimate, truth)
    error = absolute_error(
        matched.estimate, matched.reference, align(matched.estimate.poses, matched.reference.poses)
    )
    path_m = float(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum())
    report = {
        "scans": len(matched),
        "path_m": path_m,
        "ate_m": error.rmse,
        "ate_max_m": error.max,
        "ate_percent_of_path": 100 * error.rmse / path_m,
    }
    for name, value in report.items():
        print(f"{name:22}{value:10.4g}")
    if options.json:
        print(json.dumps(report))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bag", type=Path, help="a bag that lio-jax sim wrote, with its truth files")
    parser.add_argument("--world", default="city")
    parser.add_argument("--sensor", default="vlp16")
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print one JSON object on the last line")
    return parser.parse_args()


def _simulated(bag: Path, options: argparse.Namespace) -> Path:
    words = ["sim", options.world, "--sensor", options.sensor, "--duration", str(options.duration)]
    if lio_jax([*words, "--seed", str(options.seed), "--out", str(bag)]):
        raise SystemExit("the simulation failed.")
    return bag


def _tracked(bag: Path) -> Trajectory:
    """Return T_world_lidar at the time of each scan's last point, to which KISS-ICP deskews."""
    from kiss_icp.config.parser import load_config
    from kiss_icp.datasets.rosbag import RosbagDataset
    from kiss_icp.kiss_icp import KissICP

    odometry = KissICP(load_config(None))
    dataset = RosbagDataset(bag, topic="")
    stamps: list[int] = []
    poses: list[NDArray[np.float64]] = []
    for number, header_ns in enumerate(RosbagSequence(bag, DataConfig()).header_stamps()):
        points, times = dataset[number]
        odometry.register_frame(points, times)
        stamps.append(header_ns + round(float(times.max()) * 1e9))
        poses.append(odometry.last_pose)
    return Trajectory(np.array(stamps, np.int64), np.array(poses))


if __name__ == "__main__":
    main()
