"""The back end as a sink: it runs on a thread of its own and corrects the trajectory at the end."""

import math
import queue
import tempfile
import threading
import time
from collections import Counter, deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path
from lio_jax.data.gps_checks import cleaned
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory, ns_to_seconds, write_tum
from lio_jax.loops.back_end import BackEnd, Correction, corrected_poses, graph_of
from lio_jax.loops.closing import LoopCloser
from lio_jax.loops.gps import GpsGate
from lio_jax.loops.keyframe import Keyframe, thinned
from lio_jax.pose_graph.g2o import write_graph
from lio_jax.pose_graph.graph import LOOP, ODOMETRY, PoseGraph
from lio_jax.run.feedback import Feedback
from lio_jax.run.folder import write_json
from lio_jax.run.keyframes import KeyframePicker, KeyframeWriter, corner_marks, read_keyframes
from lio_jax.run.map_file import TILES_PREFIX, MapTiles, read_cloud
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.run.state_files import StateFiles
from lio_jax.run.track import ScanResult
from lio_jax.settings.settings import Settings


class BackEndThread:
    """Hands keyframes to a back end, which takes them in order, one at a time."""

    def __init__(self, back_end: BackEnd, keep_solved: bool = False) -> None:
        """Begin to wait for keyframes.

        Args:
            back_end: belongs to the thread until :meth:`finish`.
            keep_solved: keep the correction by each solve for :meth:`correction_after`.
        """
        self._back_end = back_end
        self._keep_solved = keep_solved
        self._solved: deque[tuple[int, Correction]] = deque()
        self._dealt_with: float = -1
        """Number of the last keyframe that needs no more waiting; infinite once the work has ended."""
        self._progress = threading.Condition()
        self._waiting: queue.SimpleQueue[Keyframe | None] = queue.SimpleQueue()
        self._stopped = threading.Event()
        self.error: Exception | None = None
        """What ended the work early."""
        self.busy_s = 0.0
        """Time spent on keyframes."""
        # a daemon: whatever ends the program must not wait for the queue to be worked off
        self._thread = threading.Thread(target=self._work, name="back end", daemon=True)
        self._thread.start()

    def add(self, keyframe: Keyframe) -> None:
        """Hand over the next keyframe and return at once."""
        self._waiting.put(keyframe)

    def correction_after(self, index: int) -> Correction | None:
        """Return the correction by the last solve up to a keyframe; this waits for the keyframe.

        What is returned depends on the keyframes alone, and not on the time that they take.

        Args:
            index: number of a keyframe that was handed over; it may not be smaller than in an earlier call.

        Returns:
            The correction; None where no solve has followed the correction that was returned last.
        """
        with self._progress:
            self._progress.wait_for(lambda: self._dealt_with >= index)
            found = None
            while self._solved and self._solved[0][0] <= index:
                found = self._solved.popleft()[1]
            return found

    def finish(self, hurry: bool = False) -> Correction:
        """Return the correction of all keyframes; in a hurry, of those it has dealt with.

        Where the work ended with an error, the correction is that of the keyframes before.
        """
        if hurry:
            self._stopped.set()
        self._waiting.put(None)
        self._thread.join()
        return self._back_end.correction()

    def stop(self) -> None:
        """Let the thread end after the keyframe it is at, without waiting for it."""
        self._stopped.set()
        self._waiting.put(None)

    def _work(self) -> None:
        try:
            while (keyframe := self._waiting.get()) is not None and not self._stopped.is_set():
                began, solves = time.perf_counter(), self._back_end.solves
                self._back_end.add(keyframe)
                self.busy_s += time.perf_counter() - began
                self._report(keyframe.index, self._back_end.solves > solves)
            self._back_end.settle()
        except Exception as error:
            self.error = error
        finally:
            self._report(math.inf, False)

    def _report(self, index: float, is_solved: bool) -> None:
        """Let a keyframe count as dealt with, and keep the correction if the graph was solved there."""
        with self._progress:
            if is_solved and self._keep_solved:
                self._solved.append((int(index), self._back_end.correction()))
            self._dealt_with = index
            self._progress.notify_all()


_LINES_NAMED = 5
"""Largest number of lines of a file that a warning names."""
_KEPT_SPACING = 0.4
"""Spacing of the points that keyframes keep in memory for loops, m. On disk they keep all points."""


def gps_gate(sequence: Sequence, settings: Settings) -> tuple[GpsGate, tuple[str, ...]]:
    """Return the choice of a recording's fixes, and what was found wrong with them.

    Raises:
        LioJaxError: the recording holds no fixes.
    """
    recorded = sequence.gps()
    if recorded is None or not len(recorded.stamp_ns):
        raise LioJaxError(
            f"{sequence.info.path}: holds no GPS fixes; leave config.backend.gps=true out, or name their "
            "topic by config.data.gps_topic."
        )
    gps, notes = cleaned(recorded, "GPS")
    elevation = settings.run.backend.gps_elevation
    return GpsGate(gps.stamp_ns, gps.position, gps.covariance, settings.values["gps"], elevation), notes


def light(keyframe: Keyframe) -> Keyframe:
    """Return a keyframe with the points that loops need."""
    return replace(keyframe, points=thinned(keyframe.points, _KEPT_SPACING))


class GlobalCorrection(Sink):
    """Corrects the trajectory and the map in a thread of its own, while the odometry goes on."""

    def __init__(
        self,
        sequence: Sequence,
        settings: Settings,
        out: Path,
        files: StateFiles,
        feedback: Feedback | None = None,
    ) -> None:
        """Begin a back end for a run.

        Args:
            sequence: whose GPS fixes are used.
            settings: ``config.backend``, ``config.loops``, ``params.loop``, ``params.gps``.
            out: the run folder.
            files: those of the trajectory, which are written again as it is corrected; they finish before.
            feedback: takes the corrections into the odometry; None: it goes on without them.

        Raises:
            LioJaxError: GPS is asked for and the recording holds none, or the file of pairs is damaged.
        """
        self.notes: tuple[str, ...] = ()
        """What was found wrong with the fixes."""
        backend = settings.run.backend
        self._closer = LoopCloser(settings) if backend.loops else None
        gate: GpsGate | None = None
        if backend.gps:
            gate, self.notes = gps_gate(sequence, settings)
        self._settings, self._out, self._files = settings, out, files
        self._origin = sequence.gps().origin if gate else None  # type: ignore[union-attr]
        self._picker, self._store = KeyframePicker(settings), KeyframeWriter(out)
        self._thread = BackEndThread(BackEnd(settings, self._closer, gate), feedback is not None)
        self._feedback = feedback
        self._T_map_odom: list[NDArray[np.float64]] = []
        if feedback is not None:
            feedback.follow(self._thread.correction_after)

    def take(self, result: ScanResult) -> None:
        """Take the next scan's result; this never waits for the back end."""
        keyframe = self._picker(result)
        if result.T_map_odom is not None:
            self._T_map_odom.append(result.T_map_odom)
        if keyframe is not None:
            if self._feedback is not None:
                self._feedback.add_keyframe(result.index)
            self._store.append(keyframe.points, corner_marks(result))
            self._thread.add(light(keyframe))

    def finish(self, run: RunResult) -> None:
        """Write the corrected results and hand them over; what waits still counts unless the run was ended.

        The odometry's files are written already, so that an error here loses none of them.
        """
        found = self._thread.finish(hurry=run.interruption is not None)
        run.odometry = odometry = run.trajectory
        run.metrics["backend"] = self._summary(found)
        run.metrics["warnings"] += (*self._warnings(), *self._pieces(found, odometry))
        if not len(found.stamp_ns):
            return
        poses = corrected_poses(
            odometry.stamp_ns, odometry.poses, found.stamp_ns, found.T_odom_imu, found.T_world_imu
        )
        self._store.finish(*self._of_all_stored(found, odometry, poses))
        with atomic_path(self._out / "odometry.tum") as aside:
            write_tum(aside, odometry)
        if self._feedback is not None:
            online = Trajectory(odometry.stamp_ns, np.array(self._T_map_odom) @ odometry.poses)
            with atomic_path(self._out / "online.tum") as aside:
                write_tum(aside, online)
        write_graph(self._out / "keyframes.g2o", _graph(found), np.arange(len(found.stamp_ns)))
        write_json(self._out / "loops.json", {"loops": [_loop(found, *one) for one in found.loops]})
        if found.T_enu_world is not None:
            write_json(self._out / "georeference.json", _georeference(found.T_enu_world, self._origin))
        map_points = self._written_map() if self._settings.run.output.map else None
        corrected = Trajectory(odometry.stamp_ns, poses)
        self._files.write_trajectory(corrected)
        run.trajectory, run.map_points = corrected, map_points

    def close(self) -> None:
        """Let the back end's thread end."""
        self._thread.stop()

    def _of_all_stored(
        self, found: Correction, odometry: Trajectory, poses: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return stamps and poses of the clouds on disk, also of those the back end did not get to."""
        stamps = np.array(self._picker.stamps_ns, np.int64)
        rows = np.searchsorted(odometry.stamp_ns, stamps)
        return stamps, poses[rows], odometry.poses[rows]

    def _written_map(self) -> NDArray[np.float32]:
        """Put the keyframes' clouds where the keyframes were found to be."""
        spacing = self._settings.values["map"]["point_spacing"]
        with tempfile.TemporaryDirectory(prefix=TILES_PREFIX, dir=self._out) as folder:
            tiles = MapTiles(Path(folder) / "tiles", spacing)
            for T_world_imu, points in read_keyframes(self._out).clouds():
                tiles.add(T_world_imu, points)
            tiles.write(self._out / "map.pcd")
        return read_cloud(self._out / "map.pcd")

    def _summary(self, found: Correction) -> dict[str, Any]:
        weights = [weight for _, weight in found.loops if weight is not None]
        refused = Counter(verdict.reason for verdict, weight in found.loops if weight is None)
        summary: dict[str, Any] = {
            "keyframes": len(found.stamp_ns),
            "busy_s": round(self._thread.busy_s, 3),
            "loops": {
                "closed": len(weights),
                "distrusted": sum(weight < 0.5 for weight in weights),
                "refused": dict(refused),
            },
            "gps": found.fixes,
        }
        return summary | ({"error": str(self._thread.error)} if self._thread.error else {})

    def _warnings(self) -> tuple[str, ...]:
        error = self._thread.error
        kind = type(error).__name__
        ended = f"the back end ended early ({kind}: {error}); what it had done until then counts."
        return (*self.notes, *self._unused_pairs(), *((ended,) if error else ()))

    def _pieces(self, found: Correction, odometry: Trajectory) -> list[str]:
        """Return a sentence on each piece of map after an outage: what ties it to the map before."""
        sentences = []
        for piece in self._picker.pieces:
            at_s = (self._picker.stamps_ns[piece] - int(odometry.stamp_ns[0])) * 1e-9
            loops = sum(
                verdict.proposal.target < piece <= verdict.proposal.source
                for verdict, weight in found.loops
                if weight is not None and weight > 0.5
            )
            by = [f"loops ({loops})"] * (loops > 0) + ["GPS fixes"] * (found.T_enu_world is not None)
            tie = f"{' and '.join(by)} tie" if by else "nothing ties"
            end = "" if by else "; its place there is predicted"
            sentences.append(f"a new piece of map begins at {at_s:.1f} s: {tie} it to the map before{end}.")
        return sentences

    def _unused_pairs(self) -> list[str]:
        pairs = self._closer.untried() if self._closer else []
        lines = [str(line) for line in sorted(pair.line for pair in pairs)]
        if not lines:
            return []
        named = ", ".join(lines[:_LINES_NAMED]) + (", ..." if len(lines) > _LINES_NAMED else "")
        path = self._settings.run.loops.pairs
        note = (
            f"{path}: {len(lines)} pairs closed no loop, because their times belong to no two keyframes of "
            f"this recording (lines {named}); times are in seconds, as in trajectory.tum."
        )
        return [note]


def _graph(found: Correction) -> PoseGraph:
    """Return odometry and loops, which g2o can tell, their information by the weight they were given."""
    edges = [
        replace(edge, information=edge.information * max(weight, 1e-9))
        for edge, weight in zip(found.edges, found.weights, strict=True)
        if edge.kind in (ODOMETRY, LOOP)
    ]
    return graph_of(found.T_world_imu, edges)


def _loop(found: Correction, verdict: Any, weight: float | None) -> dict[str, Any]:
    proposal = verdict.proposal
    return {
        "source": proposal.source,
        "target": proposal.target,
        "source_s": ns_to_seconds(int(found.stamp_ns[proposal.source])),
        "target_s": ns_to_seconds(int(found.stamp_ns[proposal.target])),
        "origin": proposal.origin,
        "accepted": verdict.accepted,
        "reason": verdict.reason,
        "weight": weight,
        "fitness_m2": verdict.fitness if np.isfinite(verdict.fitness) else None,
        "overlap": verdict.overlap,
    }


def _georeference(
    T_enu_world: NDArray[np.float64], origin: tuple[float, float, float] | None
) -> dict[str, Any]:
    known = origin is not None and bool(np.isfinite(origin).all())
    names = ("latitude_deg", "longitude_deg", "altitude_m")
    return {
        "origin": dict(zip(names, origin, strict=True)) if known and origin else None,
        "T_enu_world": T_enu_world.tolist(),
    }
