"""Read a run folder."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import array_of, parse_yaml, read_arrays, read_text
from lio_jax.data.trajectory import Trajectory, read_tum
from lio_jax.evaluation.association import MatchedTrajectories, match_by_time
from lio_jax.evaluation.trajectory_error import Alignment, align
from lio_jax.run.keyframes import read_keyframes
from lio_jax.run.map_file import read_cloud
from lio_jax.run.unfinished import read_unfinished


@dataclass(frozen=True, eq=False)
class CorrectionRecord:
    """The corrected trajectory, and the loops between keyframes."""

    trajectory: Trajectory
    """Corrected T_world_imu at the scans' ends."""
    keyframes: NDArray[np.float64]
    """Positions of the keyframes, (k, 3) m, world frame."""
    loops: list[dict[str, Any]]
    """Entries of loops.json."""

    def strips(self, closed: bool) -> NDArray[np.float64]:
        """Return the ends of the closed loops, or of the refused ones, (n, 2, 3) m.

        Of a keyframe's refused loops only the first is returned: there may be many.
        """
        chosen: dict[Any, tuple[int, int]] = {}
        for number, loop in enumerate(self.loops):
            trusted = loop["weight"] is not None and loop["weight"] > 0.5
            if trusted == closed:
                chosen.setdefault(number if closed else loop["source"], (loop["source"], loop["target"]))
        ends = np.array(list(chosen.values()), np.int64).reshape(-1, 2)
        return self.keyframes[ends]


def read_correction(folder: Path) -> CorrectionRecord | None:
    """Read the results of the back end; return None for a run without one.

    Raises:
        LioJaxError: a file is damaged.
    """
    if not (folder / "odometry.tum").is_file():
        return None
    path = folder / "loops.json"
    try:
        loops = json.loads(read_text(path, "run again"))["loops"]
        if misfit := _misfit(loops, _LOOPS, "loops"):
            raise ValueError(misfit)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise LioJaxError(f"{path}: cannot be read ({error}); run again.") from None
    keyframes = read_keyframes(folder).T_world_imu[:, :3, 3]
    if any(not 0 <= loop[end] < len(keyframes) for loop in loops for end in ("source", "target")):
        raise LioJaxError(f"{path}: names keyframes that {folder / 'keyframes'} does not hold; run again.")
    return CorrectionRecord(read_tum(folder / "trajectory.tum"), keyframes, loops)


_NUMBER = (int, float)
_SEGMENTS = ({"translation_percent": _NUMBER}, None)
_METRICS = {
    "recording": {},
    "prediction": str,
    "warnings": [str],
    "notes": [str],
    "failures": [{"message": str}],
    "scan_ms": {"total": {"median": _NUMBER, "p95": _NUMBER}},
    "verdict": {"state": str, "since_s": (*_NUMBER, None), "reasons": [str]},
    "backend": {
        "keyframes": _NUMBER,
        "loops": {"closed": _NUMBER, "distrusted": _NUMBER, "refused": {}},
        "gps": ({}, None),
    },
    "compile_s": _NUMBER,
    "wall_s": _NUMBER,
    "peak_rss_mb": _NUMBER,
    "environment": {},
    "ate": ({"rmse": (*_NUMBER, None), "max": (*_NUMBER, None)}, None),
    "kitti": _SEGMENTS,
    "kitti_short_10_80m": _SEGMENTS,
}
"""What a report reads of metrics.json: types, objects with keys, lists of one kind, or alternatives."""
_COLUMNS = ("scan", "points", "matches", "rmse", "iterations", "unobserved")
"""Columns of scans.npz that a report reads."""
_LOOPS = [{"source": int, "target": int, "weight": (*_NUMBER, None)}]


def _misfit(value: Any, form: Any, place: str) -> str:
    """Return what is wrong with a value read from JSON; "" if it has the form.

    Keys of the outermost object may be missing.
    """
    if isinstance(form, tuple):
        problems = [_misfit(value, one, place) for one in form]
        return "" if "" in problems else problems[0]
    if isinstance(form, dict):
        if not isinstance(value, dict):
            return f"{place or 'the whole'} is no object"
        missing = [key for key in form if place and key not in value]
        if missing:
            return f"{place} lacks {missing[0]}"
        there = (_misfit(value[key], form[key], f"{place}.{key}".lstrip(".")) for key in form if key in value)
        return next(filter(None, there), "")
    if isinstance(form, list):
        if not isinstance(value, list):
            return f"{place} is no list"
        return next(filter(None, (_misfit(one, form[0], f"an entry of {place}") for one in value)), "")
    fits = value is None if form is None else isinstance(value, form) and not isinstance(value, bool)
    return "" if fits else f"{place} is {str(value)[:40]!r}"


_NEEDED = ("states.npz", "metrics.json", "config.yaml")


@dataclass(frozen=True)
class TruthComparison:
    """Estimated poses of a run, and the true poses at the same instants."""

    matched: MatchedTrajectories
    alignment: Alignment

    @property
    def truth(self) -> Trajectory:
        """The true poses, aligned with the estimate's world as for the absolute error."""
        T_estimate_reference = np.linalg.inv(self.alignment.T_reference_estimate)
        return Trajectory(
            self.matched.reference.stamp_ns, T_estimate_reference @ self.matched.reference.poses
        )


@dataclass(frozen=True)
class RunRecord:
    """The contents of one run folder."""

    folder: Path
    metrics: dict[str, Any]
    config_yaml: str
    config: dict[str, Any]
    states: dict[str, NDArray]
    """Columns of states.npz."""
    scans: dict[str, NDArray]
    """Columns of scans.npz; empty for a run that wrote none."""
    comparison: TruthComparison | None = None
    """Comparison with the truth; None where there is no truth."""
    remarks: list[str] = field(default_factory=list)
    """Sentences on what could not be read or compared."""
    correction: CorrectionRecord | None = None
    """Results of the back end; None for a run without one."""

    @property
    def trajectory(self) -> Trajectory:
        """T_world_imu at the scans' ends, corrected if there was a back end."""
        return self.correction.trajectory if self.correction else self.odometry

    @property
    def odometry(self) -> Trajectory:
        """T_world_imu at the scans' ends as the odometry estimated it, scan by scan."""
        return Trajectory(self.states["stamps_ns"], self.states["poses"])

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time since the first pose, (n,) s."""
        return self.seconds_of(self.trajectory)

    @property
    def distance(self) -> NDArray[np.float64]:
        """Distance travelled since the first pose, (n,) m; a pose that is not finite adds nothing."""
        steps = np.linalg.norm(np.diff(self.trajectory.positions, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(np.where(np.isfinite(steps), steps, 0.0))])

    @property
    def title(self) -> str:
        """Title of the run: recording and recipe."""
        recording = self.metrics.get("recording", {}).get("name") or self.folder.name
        return f"{recording}, {self.config.get('recipe', 'unknown recipe')}"

    def seconds_of(self, trajectory: Trajectory) -> NDArray[np.float64]:
        """Return the times of another trajectory's poses, s since this run's first pose."""
        since: NDArray[np.float64] = (trajectory.stamp_ns - self.states["stamps_ns"][0]) * 1e-9
        return since

    def map_points(self) -> NDArray[np.float32] | None:
        """Return the map's points, (n, 3) m, world frame; None where the run wrote none."""
        path = self.folder / "map.pcd"
        if not path.is_file():
            return None
        return read_cloud(path)


def read_run(folder: Path) -> RunRecord:
    """Read a run folder.

    Raises:
        LioJaxError: the folder is not a run's, the run was killed, or a file of it is damaged.
    """
    missing = [name for name in _NEEDED if not (folder / name).is_file()]
    if missing and (begun := read_unfinished(folder)):
        raise LioJaxError(
            f"{folder}: its run is unfinished, so there is no report yet; {begun.resume} (trajectory.tum "
            "holds the poses so far)."
        )
    if missing:
        raise LioJaxError(f"{folder}: {missing[0]} is not there; give a folder that lio-jax run wrote.")
    reading = folder / "metrics.json"
    try:
        metrics = json.loads(read_text(reading, "run again"))
        if misfit := _misfit(metrics, _METRICS, ""):
            raise ValueError(misfit)
        reading = folder / "config.yaml"
        text = read_text(reading, "run again")
        config = parse_yaml(text)
        if not isinstance(config, dict):
            raise ValueError("it holds no settings")
        reading = folder / "states.npz"
        states = _states(read_arrays(reading))
        reading = folder / "scans.npz"
        scans = read_arrays(reading) if reading.is_file() else {}
        for name in (*_COLUMNS, *scans) if scans else ():
            array_of(scans, name, (len(states["poses"]),), "b" if name in ("lost", "failed") else "fiu")
    except (OSError, ValueError) as error:
        raise LioJaxError(f"{reading}: cannot be read ({error}); run again.") from None
    remarks: list[str] = []
    correction = read_correction(folder)
    if correction and len(correction.trajectory) != len(states["poses"]):
        raise LioJaxError(
            f"{folder / 'trajectory.tum'}: holds {len(correction.trajectory)} poses and states.npz "
            f"{len(states['poses'])}; run again."
        )
    run = RunRecord(folder, metrics, text, config, states, scans, remarks=remarks, correction=correction)
    return replace(run, comparison=_compared(folder / "truth.tum", run.trajectory, remarks))


def _states(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """Return the columns of states.npz, checked: one row for each pose."""
    if "poses" not in arrays or not arrays["poses"].size:
        raise ValueError("it holds no poses")
    count = len(array_of(arrays, "poses", (None, 4, 4), "f"))
    array_of(arrays, "stamps_ns", (count,), "iu")
    for name in ("nis", "nis_dof"):
        array_of(arrays, name, (count,))
    array_of(arrays, "velocity", (count, 3))
    array_of(arrays, "biases", (count, 6))
    array_of(arrays, "covariance", (count, 6, 6))
    if "state_covariance" in arrays:
        size = arrays["state_covariance"].shape[-1:]
        array_of(arrays, "state_covariance", (count, *size, *size))
    for name in arrays:
        array_of(arrays, name, (count,) + (None,) * (arrays[name].ndim - 1), "fiub")
    return arrays


def _compared(path: Path, estimate: Trajectory, remarks: list[str]) -> TruthComparison | None:
    if not path.is_file():
        return None
    try:
        matched = match_by_time(estimate, read_tum(path), "the estimate", "the truth")
    except LioJaxError as reason:
        remarks.append(f"The truth is not shown. {reason}")
        return None
    return TruthComparison(matched, align(matched.estimate.poses, matched.reference.poses))
