"""Names faults of the set-up while a run goes on: extrinsic, clock, axes of the IMU, beams, scan period."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.types import CONVERGED
from lio_jax.data.sequence import ImuData
from lio_jax.run.set_up_fit import SOUGHT, Equations, Fit, Poses, Samples, SetUp, equations, fitted, solved
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.run.swept_scans import SweptScan, poses_amid_sweeps, swept_scan
from lio_jax.run.track import ScanResult
from lio_jax.settings.settings import Settings

_SCANS = 20
"""Number of intervals between the scans of a window."""
_WINDOWS, _FEWEST = 10, 4
"""Number of latest windows that are judged together, and the fewest that are."""
_ROTATION_DEG, _TRANSLATION_M, _CLOCK_S = 2.0, 0.2, 0.012
"""Smaller errors are not named."""
_SIGMAS = 8.0
"""An error is named if it is so many times its standard deviation; residuals are correlated."""
_LEAST_GAIN = 1.4
"""The correction has to explain the scans better by this ratio of squared residuals."""
_TURN_LEFT, _POSITION_LEFT_M = 5e-3, 0.03
"""Residuals within a window of two seconds that no extrinsic and no clock explain, rad and m."""
_SHARE_LEFT, _LEAST_TURNING = 0.3, 0.02
"""Share of the turns that no extrinsic and no clock explain, and the root mean square turn within a window of
two seconds from which it is judged, rad."""
_STALE = 0.1
"""Share of the smallest errors that are named by which an estimated set-up may change unnoticed."""
_ITERATIONS = 4
_PAUSE_S = 5.0
"""Time after a close look that found no fault to the next one, s."""
_PAIRS, _LEAST_TURN = 2, 0.04
"""Number of turns by plan views that are needed, and the smallest one that counts, rad."""
_RATE_RANGE = (0.8, 1.25)
"""Range of the gyroscope's turn over the shown one that passes."""
_PERIODS = 20
"""Number of scans whose durations are compared with the time between them."""
_LONG, _SHORT = 1.15, 0.75
"""Range of the sweep's duration over the time between scans that passes."""


_MOVES = 3
"""Number of moves from scan to scan whose median counts."""
_FEW_BEAMS, _FAR_PER_SCAN_M = 10, 0.2
"""A sensor of so few beams that moves farther than this from scan to scan, m, sees little twice."""


@dataclass(frozen=True)
class Fault:
    """A fault of the set-up."""

    kind: str
    since_s: float
    """Time since the first scan at which it was found, s."""
    sentence: str


class SetUpCheck(Sink):
    """Compares how the scans moved with the inertial samples, in windows of two seconds."""

    def __init__(
        self, settings: Settings, imu: ImuData | None, notify: Callable[[str], None] | None = None
    ) -> None:
        """Begin without scans.

        Args:
            settings: of the run; the set-up in it is the one that is checked.
            imu: the samples of the run; None: it uses none.
            notify: takes each sentence as soon as it is known.
        """
        extrinsics = settings.values["extrinsics"]
        self._assumed = SetUp(
            Rotation.from_quat(extrinsics["rotation"]),
            np.array(extrinsics["translation"], np.float64),
            float(extrinsics["time_offset"]),
        )
        self._period_given = "config.data.scan_period" in settings.given
        self._imu, self._notify = imu, notify
        self._samples: Samples | None = None
        self._first_ns = self._last_ns = 0
        self._now_s = self._next_s = 0.0
        self._scans: list[SweptScan] = []
        self._windows: deque[tuple[Poses, Equations]] = deque(maxlen=_WINDOWS)
        self._turns: list[float] = []
        self._durations: list[float] = []
        self._intervals: list[float] = []
        self._ends: deque[float] = deque(maxlen=_SCANS)
        self._beams = 0
        self._places: deque[NDArray[np.float64]] = deque(maxlen=_MOVES + 1)
        self.faults: dict[str, Fault] = {}
        """Faults by kind, each found once."""

    def take(self, result: ScanResult) -> None:
        """Add one scan."""
        if self._samples is None:
            self._first_ns = self._last_ns = result.stamp_ns
            self._samples = _samples(self._imu, self._first_ns)
        self._now_s = (result.stamp_ns - self._first_ns) * 1e-9
        self._ends.append(self._now_s)
        self._note_period(result)
        self._note_beams(result)
        self._note_turn(result)
        if len(self._samples.seconds):
            self._note_pose(result)
        self._last_ns = result.stamp_ns

    def finish(self, run: RunResult) -> None:
        """Hand over the faults, from which the verdict takes its reasons."""
        run.metrics["set_up"] = [
            {"kind": fault.kind, "since_s": round(fault.since_s, 3), "sentence": fault.sentence}
            for fault in self.faults.values()
        ]

    def _found(self, kind: str, sentence: str) -> None:
        if kind in self.faults:
            return
        self.faults[kind] = Fault(kind, self._now_s, sentence)
        if self._notify is not None:
            self._notify(sentence)

    def _note_period(self, result: ScanResult) -> None:
        if not result.duration or result.stamp_ns <= self._last_ns or len(self._durations) >= _PERIODS:
            return
        self._durations.append(result.duration)
        self._intervals.append((result.stamp_ns - self._last_ns) * 1e-9)
        ratio = self._sweep_ratio()
        if len(self._durations) == _PERIODS and (ratio > _LONG or (ratio < _SHORT and self._period_given)):
            self._found("period", self._period_sentence())

    def _sweep_ratio(self) -> float:
        if not self._durations:
            return 1.0
        return float(np.median(self._durations) / np.median(self._intervals))

    def _period_sentence(self) -> str:
        sweep, interval = np.median(self._durations), np.median(self._intervals)
        return (
            f"the points of a scan spread over {sweep:.3f} s, but scans follow each other every "
            f"{interval:.3f} s: set config.data.scan_period where the recording has no point times, else "
            "check config.data.time_unit."
        )

    def _note_beams(self, result: ScanResult) -> None:
        self._beams = max(self._beams, result.beams or 0)
        self._places.append(result.T_world_imu[:3, 3])
        if not 0 < self._beams <= _FEW_BEAMS or len(self._places) <= _MOVES:
            return
        moved = float(np.median(np.linalg.norm(np.diff(self._places, axis=0), axis=1)))
        if result.shown_motion is not None:
            # the estimate itself may stay behind
            moved = max(moved, result.shown_motion.way / result.shown_motion.scans)
        if moved > _FAR_PER_SCAN_M:
            self._found(
                "beams",
                f"the sensor has {self._beams} beams and moves {moved:.1f} m from scan to scan: too few "
                "beams for this speed, because a scan hardly meets what the last one saw; drive more slowly, "
                "or use a sensor of more beams.",
            )

    def _note_turn(self, result: ScanResult) -> None:
        """Compare turns about the vertical that plan views show with the gyroscope's."""
        shown, samples = result.shown_motion, self._samples
        if shown is None or samples is None or shown.scans >= len(self._ends):
            return
        # in a bend the accelerometers' mean does not point up
        up = result.T_world_imu[2, :3]
        measured = _turn_about(up, samples, self._ends[-1 - shown.scans], self._now_s)
        if measured is None or min(abs(shown.turn), abs(measured)) < _LEAST_TURN:
            return
        self._turns.append(measured / shown.turn)
        wrong = [ratio for ratio in self._turns if not _RATE_RANGE[0] < ratio < _RATE_RANGE[1]]
        if len(wrong) < _PAIRS or len(wrong) <= len(self._turns) / 2:
            return
        ratio = float(np.median(wrong))
        cause = (
            "an axis has the wrong sign, or axes are exchanged" if ratio < 0 else "check its unit and axes"
        )
        self._found(
            "axes", f"about the vertical the gyroscope turns {ratio:.1f} times as far as the scans: {cause}."
        )

    def _note_pose(self, result: ScanResult) -> None:
        output = result.output
        matched = int(output.registration.status) == CONVERGED and not bool(output.lost)
        if not matched or np.asarray(output.registration.degenerate).any() or _is_new_piece(output):
            self._scans = []
            return
        assert self._samples is not None
        scan = swept_scan(result, self._samples, self._assumed, self._now_s)
        if scan is None:
            return
        self._scans.append(scan)
        if len(self._scans) <= _SCANS:
            return
        poses, self._scans = poses_amid_sweeps(self._scans, self._assumed), self._scans[-1:]
        found = equations(poses, self._samples, self._assumed)
        if found is None:
            return
        self._windows.append((poses, found))
        self._follow_estimate(result.nav)
        if len(self._windows) >= _FEWEST:
            self._judge()

    def _follow_estimate(self, nav: Any) -> None:
        """Judge the set-up that the filter has found, where it estimates extrinsic or clock."""
        assert self._samples is not None
        found = _set_up_of(nav)
        turn = float(np.degrees((self._assumed.R_imu_lidar.inv() * found.R_imu_lidar).magnitude()))
        move = float(np.linalg.norm(found.t_imu_lidar - self._assumed.t_imu_lidar))
        late = abs(found.time_offset - self._assumed.time_offset)
        if max(turn / _ROTATION_DEG, move / _TRANSLATION_M, late / _CLOCK_S) < _STALE:
            return
        self._assumed = found
        anew = [(poses, equations(poses, self._samples, found)) for poses, _ in self._windows]
        self._windows.clear()
        self._windows.extend((poses, found) for poses, found in anew if found is not None)

    def _judge(self) -> None:
        # a wrong period looks like another clock, and one wrong figure disturbs the others
        if self.faults.keys() - {"beams"} or self._now_s < self._next_s:
            return
        fit = solved([found for _, found in self._windows], self._assumed)
        if not _exceeds(self._assumed, self._assumed.stepped(fit.step), fit) and not _unexplained(fit):
            return
        self._next_s = self._now_s + _PAUSE_S
        # one wrong figure disturbs the others: each is tried alone, and the best explanation counts
        tried = {name: self._fitted(name) for name in SOUGHT}
        tried |= {axis: self._fitted(flipped=index) for index, axis in enumerate("xyz")}
        known = {name: found for name, found in tried.items() if found is not None}
        if not known:
            return
        best = min(known, key=lambda name: known[name][1].cost)
        set_up, last = known[best]
        if _unexplained(last):
            self._found("axes", self._contradiction(last))
        elif best not in SOUGHT:
            self._found(
                "axes",
                f"the gyroscope's {best} axis has the wrong sign: with the other one it turns as the scans "
                "do; correct the recorded samples.",
            )
        elif exceeded := [row for row in _exceeds(self._assumed, set_up, last) if row[0] == best]:
            sentences = {
                "rotation": self._rotation_sentence,
                "translation": self._translation_sentence,
                "clock": self._clock_sentence,
            }
            self._found(best, sentences[best](set_up, *exceeded[0][1:]))

    def _fitted(self, sought: str | None = None, flipped: int | None = None) -> tuple[SetUp, Fit] | None:
        """Return the fit of one figure, or with the other sign of an axis of the gyroscope."""
        samples = self._samples
        assert samples is not None
        if flipped is not None:
            samples = samples._replace(gyro=samples.gyro * (1 - 2 * np.eye(3)[flipped]))
        poses = [poses for poses, _ in self._windows]
        return fitted(poses, samples, self._assumed, _ITERATIONS, () if sought is None else (sought,))

    def _rotation_sentence(self, set_up: SetUp, size: float, sigma: float) -> str:
        quaternion = [round(value, 4) + 0.0 for value in set_up.R_imu_lidar.as_quat().tolist()]
        return (
            f"scans and inertial samples say that the rotation in T_imu_lidar is wrong by {size:.0f} deg "
            f"(sigma {sigma:.1f}): set params.extrinsics.rotation to about {quaternion} (xyzw)."
        )

    def _translation_sentence(self, set_up: SetUp, size: float, sigma: float) -> str:
        translation = [round(value, 2) + 0.0 for value in set_up.t_imu_lidar.tolist()]
        return (
            f"scans and inertial samples say that the translation in T_imu_lidar is wrong by {size:.2f} m "
            f"(sigma {sigma:.2f}): set params.extrinsics.translation to about {translation} m."
        )

    def _clock_sentence(self, set_up: SetUp, size: float, sigma: float) -> str:
        late = set_up.time_offset - self._assumed.time_offset
        sweep = float(np.median(self._durations)) if self._durations else 0.0
        period = float(np.median(self._intervals)) if self._intervals else 0.0
        if self._sweep_ratio() < _SHORT and abs(late - (period - sweep) / 2) < 0.3 * abs(period - sweep):
            return self._period_sentence()
        sentence = (
            f"the clocks of IMU and lidar differ by {late:+.3f} s (sigma {sigma:.3f}) from what was assumed: "
            f"set params.extrinsics.time_offset={set_up.time_offset:.3f}."
        )
        if sweep and abs(abs(late) - sweep) < 0.2 * sweep:
            end = "end" if late < 0 else "start"
            sentence += f" That is a sweep: the stamp may mark the scan's {end}, see config.data.stamp_at."
        return sentence

    def _contradiction(self, fit: Fit) -> str:
        return (
            f"scans and inertial samples contradict each other by {fit.turn_left:.3f} rad and "
            f"{fit.position_sigma:.2f} m within two seconds, whatever extrinsic and clock: axes, signs or "
            "units of the IMU are wrong, or the scans are matched wrongly; lio-jax inspect compares them by "
            "LiDAR odometry alone."
        )


def _exceeds(assumed: SetUp, found: SetUp, fit: Fit) -> list[tuple[str, float, float]]:
    """Return name, size and standard deviation of each figure that is wrong, in deg, m and s."""
    if fit.gain < _LEAST_GAIN:
        return []
    sigma = np.sqrt(np.diag(fit.covariance))
    turn = np.degrees((assumed.R_imu_lidar.inv() * found.R_imu_lidar).as_rotvec())
    move = assumed.R_imu_lidar.inv().apply(found.t_imu_lidar - assumed.t_imu_lidar)
    late = np.array([found.time_offset - assumed.time_offset])
    rows = []
    for name, error, unit, least in (
        ("rotation", turn, 180 / np.pi, _ROTATION_DEG),
        ("translation", move, 1.0, _TRANSLATION_M),
        ("clock", late, 1.0, _CLOCK_S),
    ):
        size = float(np.linalg.norm(error))
        along = float(np.linalg.norm(unit * sigma[SOUGHT[name]] * error) / max(size, 1e-12))
        if size > max(least, _SIGMAS * along):
            rows.append((name, size, along))
    return rows


def _unexplained(fit: Fit) -> bool:
    if fit.turning > _LEAST_TURNING and fit.turn_left > _SHARE_LEFT * fit.turning:
        return True
    return fit.turn_sigma > _TURN_LEFT or fit.position_sigma > _POSITION_LEFT_M


def _turn_about(axis: NDArray[np.float64], samples: Samples, start: float, end: float) -> float | None:
    """Return the gyroscope's turn about an axis between two times, rad; None: there are no samples.

    Args:
        axis: (3,) unit vector, IMU frame.
        samples: all of the run.
        start: s since the run's origin.
        end: s since the run's origin.
    """
    first, last = np.searchsorted(samples.seconds, [start, end]).tolist()
    if last - first < 2:
        return None
    return float(samples.gyro[first:last].mean(axis=0) @ axis * (end - start))


def _set_up_of(nav: Any) -> SetUp:
    wxyz_xyz = np.asarray(nav.T_imu_lidar.wxyz_xyz, np.float64)
    rotation = Rotation.from_quat(wxyz_xyz[:4], scalar_first=True)
    return SetUp(rotation, wxyz_xyz[4:], float(nav.time_offset))


def _is_new_piece(output: object) -> bool:
    new_piece = getattr(output, "new_piece", None)
    return new_piece is not None and bool(new_piece)


def _samples(imu: ImuData | None, origin_ns: int) -> Samples:
    if imu is None:
        return Samples(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    seconds = np.asarray((imu.stamp_ns - origin_ns) * 1e-9, np.float64)
    return Samples(seconds, imu.gyro, imu.accel)
