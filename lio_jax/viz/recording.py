"""Write a run as a rerun recording (.rrd): the one place that knows rerun's API.

Nothing is sent anywhere: the stream has a file as its only sink, starts no viewer and no server, and is
never made rerun's global recording. (rerun collects usage data in its viewer and command line, not in its
library.)
"""

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path
from lio_jax.viz.colour import colour_by_height

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

_MAX_SCAN_POINTS = 5_000
_MIN_SCAN_POINTS = 1_000
_MAX_MAP_POINTS = 300_000
# Scans take 16 bytes a point; a long recording gets fewer points a scan instead of a file nobody can open.
_SCAN_BUDGET_BYTES = 150_000_000
_BYTES_PER_POINT = 16
# The whole strip is written anew each time it has grown by this share: its bytes stay linear in the run.
_STRIP_GROWTH = 1.03
_STRIP_MIN_STEP = 10
_ESTIMATE_COLOUR = (31, 119, 180)
_TRUTH_COLOUR = (44, 160, 44)


class Recording:
    """A context manager that writes ``path`` aside and renames it when it ends without an exception.

    Entities: world/lidar (pose), world/lidar/scan, world/trajectory, world/truth, world/map, metrics/NAME.
    Time lines: "scan" (index) and "time" (the recording's own clock).
    """

    def __init__(self, path: Path, scan_count: int | None = None) -> None:
        """Open the file.

        Args:
            path: the .rrd to be written.
            scan_count: number of scans to come where it is known; long runs get fewer points a scan.

        Raises:
            LioJaxError: the file cannot be created.
        """
        import rerun as rr

        self._path = path
        self._scan_points = _MAX_SCAN_POINTS
        if scan_count:
            affordable = _SCAN_BUDGET_BYTES // (_BYTES_PER_POINT * scan_count)
            self._scan_points = int(np.clip(affordable, _MIN_SCAN_POINTS, _MAX_SCAN_POINTS))
        self._positions: list[NDArray[np.float32]] = []
        self._strip_length = 0
        self._stream: rr.RecordingStream | None = rr.RecordingStream("lio_jax")
        self._file = atomic_path(path)
        try:
            self._stream.save(self._file.__enter__(), default_blueprint=_blueprint())
        except Exception as error:
            self._end(error)
            raise LioJaxError(f"{path}: the recording cannot be created ({error}).") from None
        # The wall clock of the computer is no part of the result.
        self._stream.set_log_time_enabled(False)
        self._stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        # Negative radii are screen points: thin at any zoom.
        self._stream.log("world/lidar/scan", rr.Points3D.from_fields(radii=-1.5), static=True)
        self._stream.log("world/map", rr.Points3D.from_fields(radii=-1.0), static=True)

    def log_scan(
        self,
        index: int,
        stamp_ns: int,
        points: NDArray[np.float32],
        T_world_lidar: NDArray[np.float64],
    ) -> None:
        """Log one scan and its pose; the trajectory strip grows with it.

        Args:
            index: of the scan.
            stamp_ns: absolute time of the pose, ns.
            points: (n, 3) m in the lidar frame, thinned here; colour shows the height over the sensor.
            T_world_lidar: (4, 4); a scan whose pose is not finite is left out.
        """
        import rerun as rr

        stream = self._at(index, stamp_ns)
        if not np.isfinite(T_world_lidar).all():
            return
        quaternion = Rotation.from_matrix(T_world_lidar[:3, :3]).as_quat()
        stream.log(
            "world/lidar",
            rr.Transform3D(translation=T_world_lidar[:3, 3], quaternion=rr.Quaternion(xyzw=quaternion)),
        )
        thinned = _thinned(points, self._scan_points)
        heights = thinned @ T_world_lidar[2, :3].astype(np.float32)
        stream.log("world/lidar/scan", rr.Points3D(thinned, colors=colour_by_height(heights, -2.0, 8.0)))
        self._positions.append(T_world_lidar[:3, 3].astype(np.float32))
        if len(self._positions) >= max(
            self._strip_length * _STRIP_GROWTH, self._strip_length + _STRIP_MIN_STEP
        ):
            self.log_trajectory(np.array(self._positions))
            self._strip_length = len(self._positions)

    def log_metrics(self, index: int, stamp_ns: int, values: dict[str, float]) -> None:
        """Log scalars of a scan as metrics/NAME (for example scan_ms)."""
        import rerun as rr

        stream = self._at(index, stamp_ns)
        for name, value in values.items():
            stream.log(f"metrics/{name}", rr.Scalars(float(value)))

    def log_map(self, points: NDArray[np.float32], *, static: bool = True) -> None:
        """Log (n, 3) map points in world, thinned to what a viewer takes.

        Static points are shown at every time (the final map); otherwise from the last logged scan on.
        """
        import rerun as rr

        thinned = _thinned(points, _MAX_MAP_POINTS)
        low, high = np.percentile(thinned[:, 2], [2.0, 98.0]) if len(thinned) else (0.0, 1.0)
        colours = colour_by_height(thinned[:, 2], float(low), float(high))
        self._open_stream().log("world/map", rr.Points3D(thinned, colors=colours), static=static)

    def log_trajectory(self, positions: NDArray[np.floating]) -> None:
        """Log the (n, 3) positions in world as they are known at the last logged scan."""
        self._log_strip("world/trajectory", positions, _ESTIMATE_COLOUR, static=False)

    def log_truth(self, positions: NDArray[np.floating]) -> None:
        """Log the (n, 3) true positions, already laid into the estimate's world, for all times."""
        self._log_strip("world/truth", positions, _TRUTH_COLOUR, static=True)

    def close(self) -> None:
        """Finish the file and give it its name; closing twice is allowed.

        Raises:
            LioJaxError: the file could not be written.
        """
        if self._stream is None:
            return
        if self._strip_length < len(self._positions):
            self.log_trajectory(np.array(self._positions))
        try:
            self._end(None)
        except OSError as error:
            raise LioJaxError(f"{self._path}: the recording could not be written ({error}).") from None

    def __enter__(self) -> "Recording":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        elif self._stream is not None:
            self._end(error)

    def _end(self, error: BaseException | None) -> None:
        assert self._stream is not None
        self._stream.disconnect()
        self._stream = None
        self._file.__exit__(None if error is None else type(error), error, None)

    def _log_strip(
        self, entity: str, positions: NDArray[np.floating], colour: tuple[int, int, int], *, static: bool
    ) -> None:
        import rerun as rr

        strip = np.asarray(positions, np.float32)
        self._open_stream().log(entity, rr.LineStrips3D([strip], colors=[colour], radii=-2.0), static=static)

    def _open_stream(self) -> "rr.RecordingStream":
        if self._stream is None:
            raise LioJaxError(f"{self._path}: the recording is closed; log before close().")
        return self._stream

    def _at(self, index: int, stamp_ns: int) -> "rr.RecordingStream":
        stream = self._open_stream()
        stream.set_time("scan", sequence=index)
        stream.set_time("time", timestamp=np.datetime64(stamp_ns, "ns"))
        return stream


def _thinned(points: NDArray[np.floating], limit: int) -> NDArray[np.float32]:
    """Return at most ``limit`` of the points, spread evenly over their order."""
    if len(points) > limit:
        points = points[np.linspace(0, len(points) - 1, limit).astype(np.int64)]
    return np.ascontiguousarray(points, np.float32)


def _blueprint() -> "rrb.Blueprint":
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Spatial3DView(origin="world", name="world"),
            rrb.TimeSeriesView(origin="metrics", name="metrics"),
            row_shares=[4, 1],
        ),
        rrb.TimePanel(timeline="scan"),
        collapse_panels=True,
    )
