"""The only module that uses rerun: recordings, and the layout of its viewer."""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb


# Blue to yellow in even steps of lightness: the order is visible without colour vision and in grey print.
_ANCHORS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64)


def _packed_table(size: int) -> NDArray[np.uint32]:
    where = np.linspace(0.0, len(_ANCHORS) - 1.0, size)
    channels = [np.interp(where, np.arange(len(_ANCHORS)), column).round() for column in _ANCHORS.T]
    red, green, blue = (channel.astype(np.uint32) for channel in channels)
    return (red << 24) | (green << 16) | (blue << 8) | np.uint32(255)


_TABLE = _packed_table(256)


def colour_by_height(height: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint32]:
    """Return (n,) packed 0xRRGGBBAA colours, from dark blue at ``low`` m to yellow at ``high`` m."""
    share = (height - low) / max(high - low, 1e-6)
    return _TABLE[np.clip(share * (len(_TABLE) - 1), 0, len(_TABLE) - 1).astype(np.int64)]


RAW, ADDED = "world/lidar/raw", "world/added"
"""Entities that are hidden at first, because they cover the compensated scan and the map."""
PLOTS = {
    "match": "metrics/match",
    "state": "metrics/state",
    "times": "metrics/times",
}
"""Views of scalars, by name."""


def default_blueprint() -> "rrb.Blueprint":
    """Return the layout of the viewer for a run."""
    import rerun.blueprint as rrb

    hidden = rrb.EntityBehavior(visible=False)
    world = rrb.Spatial3DView(origin="world", name="world", overrides={RAW: hidden, ADDED: hidden})
    plots = [
        rrb.TimeSeriesView(origin=f"{origin}/{group}", name=title)
        for origin, group, title in (
            (PLOTS["match"], "residual_m", "residual [m]"),
            (PLOTS["match"], "points", "points matched"),
            (PLOTS["match"], "nis", "NIS"),
            (PLOTS["state"], "gyro_bias", "gyroscope bias and sigma [rad/s]"),
            (PLOTS["state"], "accel_bias", "accelerometer bias and sigma [m/s^2]"),
            (PLOTS["times"], "", "times [ms]"),
        )
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            world,
            rrb.Tabs(
                rrb.Vertical(*plots[:3], name="match"),
                rrb.Vertical(*plots[3:5], name="biases"),
                rrb.Vertical(plots[5], name="times"),
            ),
            column_shares=[3, 1],
        ),
        rrb.TimePanel(timeline="scan", state="collapsed"),
        collapse_panels=True,
    )


_MAX_SCAN_POINTS = 5_000
_MIN_SCAN_POINTS = 1_000
CLOUD_BUDGET_BYTES = 150_000_000
"""Bytes for all scans' clouds: longer recordings get fewer points a scan, then every n-th scan only."""
BYTES_PER_POINT = 40
"""Bytes per point of a scan: compensated with colour, raw, and features or points that are new in the map."""
MAX_MAP_POINTS = 300_000
_MAP_PIECES = 40
"""Number of pieces of the map; each piece is shown from the time at which it was seen."""
_PIECE_SCANS = 50
"""Number of scans in a piece if the number of scans of the run is not known beforehand."""
# The whole path is written again each time it has grown by this share: its bytes stay linear in the run.
_STRIP_GROWTH = 1.03
_STRIP_MIN_STEP = 10
_ESTIMATE_COLOUR = (31, 119, 180)
_TRUTH_COLOUR = (44, 160, 44)
_RAW_COLOUR, _ADDED_COLOUR = (150, 150, 150), (230, 80, 60)
_CORNER_COLOUR, _SURFACE_COLOUR = (214, 39, 40), (23, 190, 207)
SIGMA_SCALE = 100.0
"""Factor by which ellipsoids are enlarged: standard deviations of the position are centimetres."""
_CORRECTED_COLOUR, _CLOSED_COLOUR, _REFUSED_COLOUR = (148, 103, 189), (44, 160, 44), (214, 39, 40)
_ARROW_M = 5.0


class ViewerRecording:
    """A context manager that writes a hidden file and renames it to ``path`` if no exception ends the block.

    Entities: world/lidar (pose), world/lidar/scan (compensated), world/lidar/raw, world/lidar/corners and
    surfaces, world/lidar/unobserved, world/imu (pose), world/imu/position_100_sigma, world/added,
    world/map/NN, world/trajectory, world/truth, metrics/GROUP/NAME; with a back end also world/corrected,
    world/keyframes, world/loops/closed and refused.
    Time lines: "scan" (index) and "time" (the recording's own clock).
    """

    def __init__(self, path: Path, scan_count: int | None = None, live: str | None = None) -> None:
        """Open the file.

        Args:
            path: path of the .rrd file to write.
            scan_count: number of scans to come, if known; long runs get fewer points a scan.
            live: address of a viewer's server that also gets everything at once.

        Raises:
            LioJaxError: the file cannot be created.
        """
        import rerun as rr

        self._path = path
        self._scan_points, self._cloud_every = _MAX_SCAN_POINTS, 1
        self._piece_scans = _PIECE_SCANS
        if scan_count:
            affordable = CLOUD_BUDGET_BYTES // (BYTES_PER_POINT * scan_count)
            self._scan_points = int(np.clip(affordable, _MIN_SCAN_POINTS, _MAX_SCAN_POINTS))
            self._cloud_every = max(1, -(-_MIN_SCAN_POINTS // max(affordable, 1)))
            self._piece_scans = max(1, -(-scan_count // _MAP_PIECES))
        self._piece: list[NDArray[np.float32]] = []
        self._piece_start, self._pieces = 0, 0
        self._positions: list[NDArray[np.float32]] = []
        self._strip_length = 0
        self._stream: rr.RecordingStream | None = rr.RecordingStream("lio_jax")
        self._file = atomic_path(path)
        try:
            sinks: list[Any] = [rr.FileSink(self._file.__enter__())]
            sinks += [rr.GrpcSink(live)] if live else []
            self._stream.set_sinks(*sinks, default_blueprint=default_blueprint())
        except Exception as error:
            self._end(error)
            raise LioJaxError(f"{path}: the recording cannot be created ({error}).") from None
        # The wall clock of the computer is no part of the result.
        self._stream.set_log_time_enabled(False)
        self._stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def shows_cloud(self, index: int) -> bool:
        """Return whether a scan's clouds are logged; in long recordings only every n-th scan's are."""
        return index % self._cloud_every == 0

    def log_pose(self, index: int, stamp_ns: int, entity: str, pose: NDArray[np.float64]) -> None:
        """Log a frame's (4, 4) pose in the world; a pose that is not finite is left out."""
        import rerun as rr

        stream = self._at(index, stamp_ns)
        if np.isfinite(pose).all():
            quaternion = rr.Quaternion(xyzw=Rotation.from_matrix(pose[:3, :3]).as_quat())
            stream.log(entity, rr.Transform3D(translation=pose[:3, 3], quaternion=quaternion))

    def log_scan(
        self,
        index: int,
        stamp_ns: int,
        points: NDArray[np.float32],
        T_world_lidar: NDArray[np.float64],
        raw: NDArray[np.float32] | None = None,
        corners: NDArray[np.bool_] | None = None,
    ) -> None:
        """Log one scan and its pose; the path grows with it.

        Args:
            index: index of the scan.
            stamp_ns: absolute time of the pose, ns.
            points: (n, 3) m, lidar frame, compensated; they are thinned here, and their colour shows the
                height.
            T_world_lidar: (4, 4); a scan whose pose is not finite is left out.
            raw: (m, 3) m, points as recorded.
            corners: (n,) which of ``points`` are corners; the others are surfaces.
        """
        if not np.isfinite(T_world_lidar).all():
            return
        self.log_pose(index, stamp_ns, "world/lidar", T_world_lidar)
        if self.shows_cloud(index):
            heights = points @ T_world_lidar[2, :3].astype(np.float32)
            self._log_points("world/lidar/scan", points, colour_by_height(heights, -2.0, 8.0))
            if raw is not None:
                self._log_points(RAW, raw, _RAW_COLOUR)
            if corners is not None:
                self._log_points("world/lidar/corners", points[corners], _CORNER_COLOUR, -2.5)
                self._log_points("world/lidar/surfaces", points[~corners], _SURFACE_COLOUR, -2.0)
        self._positions.append(T_world_lidar[:3, 3].astype(np.float32))
        if len(self._positions) >= max(
            self._strip_length * _STRIP_GROWTH, self._strip_length + _STRIP_MIN_STEP
        ):
            self.log_trajectory(np.array(self._positions))
            self._strip_length = len(self._positions)

    def log_added(self, index: int, stamp_ns: int, points: NDArray[np.float32]) -> None:
        """Log the (n, 3) points that a scan adds to the map, m, world frame; the map grows in pieces."""
        self._at(index, stamp_ns)
        if index - self._piece_start >= self._piece_scans:
            self._log_piece()
            self._piece_start = index
        # thinned on arrival, so that the memory of a piece is bounded, too
        limit = max(1, MAX_MAP_POINTS // (_MAP_PIECES * self._piece_scans))
        self._piece.append(_thinned(points, limit))
        if self.shows_cloud(index):
            self._log_points(ADDED, points, _ADDED_COLOUR)

    def log_sigma(self, covariance: NDArray[np.float64]) -> None:
        """Log the (3, 3) covariance of the position at the last logged scan, m^2, IMU axes, enlarged."""
        import rerun as rr

        if not np.isfinite(covariance).all():
            return
        variances, axes = np.linalg.eigh(covariance)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        sizes = SIGMA_SCALE * np.sqrt(np.maximum(variances, 0.0))
        quaternion = rr.Quaternion(xyzw=Rotation.from_matrix(axes).as_quat())
        self._open_stream().log(
            f"world/imu/position_{SIGMA_SCALE:.0f}_sigma",
            rr.Ellipsoids3D(half_sizes=[sizes], quaternions=[quaternion], colors=[_ESTIMATE_COLOUR]),
        )

    def log_unobserved(self, directions: NDArray[np.float64]) -> None:
        """Log the (k, 3) directions that the last logged scan leaves unobserved, lidar frame; none clears."""
        import rerun as rr

        arrows = rr.Arrows3D(vectors=_ARROW_M * directions, colors=[_ADDED_COLOUR] * len(directions))
        self._open_stream().log("world/lidar/unobserved", arrows)

    def log_metrics(self, index: int, stamp_ns: int, values: Mapping[str, ArrayLike]) -> None:
        """Log scalars of a scan, or several under one name, as metrics/NAME (for example times/step)."""
        import rerun as rr

        stream = self._at(index, stamp_ns)
        for name, value in values.items():
            stream.log(f"metrics/{name}", rr.Scalars(np.asarray(value, np.float64)))

    def log_trajectory(self, positions: NDArray[np.floating]) -> None:
        """Log the (n, 3) positions, world frame, as they are estimated at the last logged scan."""
        self._log_strip("world/trajectory", positions, _ESTIMATE_COLOUR, static=False)

    def log_correction(
        self, positions: NDArray[np.floating], keyframes: NDArray[np.floating], loops: Mapping[str, NDArray]
    ) -> None:
        """Log the results of the back end at the last logged scan.

        Args:
            positions: (n, 3) m, world frame, of the corrected trajectory.
            keyframes: (k, 3) m, world frame.
            loops: "closed" and "refused": the ends of each loop, (m, 2, 3) m, world frame.
        """
        import rerun as rr

        self._log_strip("world/corrected", positions, _CORRECTED_COLOUR, static=False)
        self._log_points("world/keyframes", keyframes, _CORRECTED_COLOUR, -3.0)
        for name, colour in (("closed", _CLOSED_COLOUR), ("refused", _REFUSED_COLOUR)):
            strips = np.asarray(loops[name], np.float32)
            self._open_stream().log(
                f"world/loops/{name}", rr.LineStrips3D(strips, colors=[colour], radii=-1.5)
            )

    def log_truth(self, positions: NDArray[np.floating]) -> None:
        """Log the (n, 3) true positions, already aligned with the estimate's world, for all times."""
        self._log_strip("world/truth", positions, _TRUTH_COLOUR, static=True)

    def close(self) -> None:
        """Finish the file and rename it to its path; closing twice is allowed.

        Raises:
            LioJaxError: the file could not be written.
        """
        if self._stream is None:
            return
        self._log_piece()
        if self._strip_length < len(self._positions):
            self.log_trajectory(np.array(self._positions))
        try:
            self._end(None)
        except OSError as error:
            raise LioJaxError(f"{self._path}: the recording could not be written ({error}).") from None

    def __enter__(self) -> "ViewerRecording":
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

    def _log_piece(self) -> None:
        """Log the complete piece of the map."""
        points = np.concatenate(self._piece) if self._piece else np.zeros((0, 3), np.float32)
        self._piece = []
        if not len(points):
            return
        low, high = np.percentile(points[:, 2], [2.0, 98.0])
        entity = f"world/map/{self._pieces:02d}"
        self._log_points(entity, points, colour_by_height(points[:, 2], float(low), float(high)), -1.0)
        self._pieces += 1

    def _log_points(self, entity: str, points: NDArray, colours: Any, radius: float = -1.5) -> None:
        """Log points, thinned if they are a scan's; a negative radius is in screen points."""
        import rerun as rr

        kept: Any = slice(None)
        if not entity.startswith("world/map/"):
            kept = _spread(len(points), self._scan_points)
        colours = colours[kept] if isinstance(colours, np.ndarray) else [colours]
        positions = np.ascontiguousarray(points[kept], np.float32)
        self._open_stream().log(entity, rr.Points3D(positions, colors=colours, radii=[radius]))

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
    """Return at most ``limit`` of the points, evenly spaced in their order."""
    return np.ascontiguousarray(points[_spread(len(points), limit)], np.float32)


def _spread(count: int, limit: int) -> Any:
    """Return which of ``count`` items are kept: at most ``limit``, evenly spaced."""
    return slice(None) if count <= limit else np.linspace(0, count - 1, limit).astype(np.int64)
