"""Print how long parts of a run on the host take, ms: median of many repeats.

python experiments/bench/host_parts.py

The parts are the decoding of a cloud of 131,072 points, one scan in a recording for the viewer, and the KITTI
devkit's errors over 4,541 poses.
"""

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import numpy as np

from lio_jax.data.pointcloud2 import decode_pointcloud2
from lio_jax.evaluation.kitti_segments import kitti_errors
from lio_jax.viz.recording import ViewerRecording

POINTS, SHOWN_POINTS, POSES = 131_072, 10_000, 4_541


def median_ms(part: Callable[[int], object], repeats: int) -> float:
    """Return the median time of calls with 0, 1, ..., ms."""
    taken = []
    for index in range(repeats):
        began = time.perf_counter()
        part(index)
        taken.append(1e3 * (time.perf_counter() - began))
    return statistics.median(taken)


def cloud_message() -> SimpleNamespace:
    """Return a PointCloud2 message as an Ouster driver fills it."""
    layout = {"x": 0, "y": 4, "z": 8, "intensity": 16, "t": 20, "ring": 26}
    kinds = {"x": 7, "y": 7, "z": 7, "intensity": 7, "t": 6, "ring": 4}
    points = np.zeros((POINTS, 48), np.uint8)
    random = np.random.default_rng(0)
    points[:, :12] = random.normal(0, 20, (POINTS, 3)).astype("<f4").view(np.uint8)
    points[:, 20:24] = np.linspace(0, 1e8, POINTS).astype("<u4")[:, None].view(np.uint8)
    fields = [SimpleNamespace(name=n, offset=at, datatype=kinds[n], count=1) for n, at in layout.items()]
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="lidar"),
        height=128,
        width=POINTS // 128,
        point_step=48,
        row_step=48 * POINTS // 128,
        fields=fields,
        data=points.ravel(),
        is_bigendian=False,
    )


def main() -> None:
    """Print the table."""
    message = cloud_message()
    shown = np.random.default_rng(0).normal(size=(SHOWN_POINTS, 3)).astype(np.float32)
    poses = np.tile(np.eye(4), (POSES, 1, 1))
    poses[:, 0, 3] = np.arange(POSES)
    with TemporaryDirectory() as folder, ViewerRecording(Path(folder) / "timed.rrd") as recording:
        rows = {
            "decode a cloud of 131,072 points": median_ms(lambda _: decode_pointcloud2(message), 20),
            "record a scan for the viewer": median_ms(
                lambda index: recording.log_scan(index, index, shown, np.eye(4)), 100
            ),
            "KITTI errors over 4,541 poses": median_ms(lambda _: kitti_errors(poses, poses), 5),
        }
    for name, taken in rows.items():
        print(f"{name:36s}{taken:8.2f}")


if __name__ == "__main__":
    main()
