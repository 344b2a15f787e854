"""Short simulated drives and specifications over them."""

from pathlib import Path

import yaml

SMALL = {
    "config.lidar.buckets": [4096],
    "config.imu.buckets": [64],
    "config.imu.registration_points": 512,
    "config.imu.insertion_points": 2048,
    "config.map.capacity": 16384,
}
DRIVE = {"sim": "street", "duration": 1.0, "beams": 8, "columns": 256}
GRID = {"params.map.voxel_size": [0.8, 1.2], "params.registration.kernel": [0.1, 0.3]}


def write_spec(path: Path, **changes: object) -> Path:
    """Write a specification: one short drive with four settings, or what is given instead."""
    tree = {"set": SMALL, "sequences": [DRIVE], "grid": GRID, "metrics": ["ate.rmse", "rpe.rmse"], **changes}
    tree = {key: value for key, value in tree.items() if value is not None}
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    return path
