"""The judgement on a whole run: sound, doubtful from an instant on, or lost from an instant on."""

from bisect import insort
from collections import deque
from dataclasses import dataclass, field
from statistics import fmean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.types import CONVERGED, ITERATION_LIMIT
from lio_jax.run.failures import largest_sigma
from lio_jax.run.shown_motion import Agreement
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.run.track import ScanResult
from lio_jax.settings.settings import Settings

TOLERATED_M, TOLERATED_SHARE = 1.0, 0.05
"""An error above this distance, m, or above this share of the way, makes a trajectory doubtful."""
_CONTRADICTED_M = 0.3
"""Error of the motion against the plan view that counts, m; of a long way the tolerated share counts, up to
the tolerated distance. Where a plan view is certain it is right to 0.2 m."""
_SHOWN_NOISES = 3.0
"""Error against the plan view that counts, over the median of those before: among bushes and few poles a view
is right to 0.15 m only."""
_WINDOW = 20
"""Number of scans over which convergence and the normalised innovation are averaged, and of plan views."""
_UNCONVERGED = 0.5
"""Share of the window's scans that may end without convergence."""
_LARGEST_NIS = 25.0
"""Largest mean of the normalised innovation per degree of freedom over the window; 1 is expected."""
_RAISED_NIS, _RAISED_RATIO = 5.0, 3.0
"""Median of the normalised innovation per degree of freedom over the window that counts, and its ratio to the
median of all scans before the window: a filter whose noise is set too small has a high one from the start."""
_FELT_M, _FELT_NOISES = 0.3, 4.0
"""Difference of the estimated from the felt motion that counts, m, and over the median of those before."""
_VERTICAL = 0.9
"""Share of that difference along the vertical from which it is called vertical."""
_LOST_S = 1.0
"""Time without a match at the end of a run from which it ends lost, s."""
_STRONGEST, _ROUGHEST = 30.0, 10.0
"""Largest acceleration from scan to scan, and largest median of it over ten scans, m/s^2: no body that drives
or is carried reaches them, a match that jumps does."""
_ROUGH_SCANS = 10
_UNOBSERVED_M = 20.0
"""Way with an unobserved direction of motion that is tolerated where no inertial samples bridge it, m."""
_UNOBSERVED_S = 5.0
"""Time with an unobserved direction that inertial samples bridge, s: an attitude that is 0.5 deg off moves
the position by 1 m in it."""
_UNMEASURED_S, _UNMEASURED_M = 1.5, 0.5
"""Time with an unobserved direction that is tolerated without inertial samples, s, and three standard
deviations of the position, m: a vehicle that accelerates by 0.5 m/s^2 moves by 0.5 m in this time, and the
velocity of before does not show it."""
_SIGMAS = 4.0
"""Such a time counts where so many standard deviations of the position exceed the tolerated error."""
_BY_NOISE_M = 0.25
"""Estimated motion in a direction that noise alone may show that counts, m: half of the error that a warning
is to precede. The motion in truth may be none."""
_MISPLACED_CELLS, _MISPLACED_SHARE = 40, 0.1
"""Number of cells in which something stands that successive plan views must show, and the largest share of
them that the estimated motion puts where something stood before, if it is wrong. Right motions reach 0.5, and
0.15 where almost nothing stands upright."""
_HIDDEN_LOOKS = 2
"""Number of successive plan views without a certain motion from which it counts as hidden."""


@dataclass
class _Evidence:
    """What is summed over the scans."""

    way: float = 0.0
    unmatched_since_s: float | None = None
    observed_s: float = 0.0
    """Time of the last scan that showed all directions, s."""
    unobserved_m: float = 0.0
    contradictions: int = 0
    by_noise: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """(3,) motion in directions that noise alone may show, since the last scan without any, m."""
    noise_believed: bool = False
    """Whether a match since that scan has used what it knows of such a direction."""
    by_noise_since_s: float = 0.0
    """Time of that scan, s."""
    hidden_m: float = 0.0
    hidden_since_s: float = 0.0
    hidden_looks: int = 0
    shown_step: float = 0.0
    agreements: deque[tuple[float, Agreement]] = field(default_factory=deque)
    """Those of the latest plan views without a certain motion, each with its time, s."""
    last: tuple[NDArray[np.float64], float] | None = None
    shown_errors: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    accelerations: deque[float] = field(default_factory=lambda: deque(maxlen=_ROUGH_SCANS))
    unconverged: deque[bool] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    nis: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    earlier_nis: list[float] = field(default_factory=list)
    """Those before the window."""
    felt_errors: list[float] = field(default_factory=list)


class Verdict(Sink):
    """Judges a run from its scans."""

    def __init__(self, settings: Settings) -> None:
        """Begin without evidence; ``settings``: of the run."""
        self._outage_s = settings.values["limits"]["outage"]
        self._seen = _Evidence()
        self._first_ns: int | None = None
        self._before: ScanResult | None = None
        self._reasons: dict[str, tuple[float, str]] = {}
        self._now_s = 0.0

    def take(self, result: ScanResult) -> None:
        """Add the evidence of one scan."""
        if self._first_ns is None:
            self._first_ns = result.stamp_ns
        self._now_s = (result.stamp_ns - self._first_ns) * 1e-9
        step = 0.0
        if self._before is not None:
            step = float(np.linalg.norm(result.T_world_imu[:3, 3] - self._before.T_world_imu[:3, 3]))
        self._seen.way += step
        sigma = _sigma(result.output.covariance)
        self._note_outage(result, sigma)
        self._note_motion(result)
        self._note_misplaced(result)
        self._note_felt(result)
        self._note_window(result, sigma)
        self._note_unobserved(result, step, sigma)
        self._note_by_noise(result)
        self._note_hidden(result, step)
        self._note_jumps(result)
        self._before = result

    def finish(self, run: RunResult) -> None:
        """Hand over the verdict; a fault of the set-up makes a sound run doubtful."""
        for fault in run.metrics.get("set_up", ()):
            self._doubt(fault["kind"], fault["sentence"].removesuffix("."), fault["since_s"])
        run.metrics["verdict"] = self.verdict()

    def verdict(self) -> dict[str, Any]:
        """Return state, the time since the first scan from which it holds (s), and the reasons."""
        reasons = dict(self._reasons)
        since, state = self._seen.unmatched_since_s, "doubtful" if reasons else "sound"
        if since is not None and self._now_s - since >= _LOST_S:
            state = "lost"
            reasons["lost"] = since, f"from {since:.1f} s on no scan was matched"
        elif self._seen.contradictions > 1:
            state = "lost"
        if state == "lost" and self._seen.contradictions > 1:
            since = reasons["motion"][0]
        elif reasons and state == "doubtful":
            since = min(time for time, _ in reasons.values())
        ordered = sorted(reasons.values())
        return {
            "state": state,
            "since_s": None if state == "sound" or since is None else round(float(since), 3),
            "reasons": [f"{words}." for _, words in ordered],
        }

    def _doubt(self, kind: str, words: str, since_s: float | None = None) -> None:
        self._reasons.setdefault(kind, (self._now_s if since_s is None else since_s, words))

    def _note_outage(self, result: ScanResult, sigma: float | None) -> None:
        output, before = result.output, self._before
        # a scan that begins the map is matched with nothing, and no other one should be
        lost = bool(output.lost) or (before is not None and int(output.registration.matches) == 0)
        unmatched = self._seen.unmatched_since_s
        if lost and unmatched is None and before is not None:
            unmatched = (before.stamp_ns - (self._first_ns or 0)) * 1e-9
        if (outage := result.outage) is not None:
            error = outage.position if sigma is None else sigma
            if error > TOLERATED_M or error > TOLERATED_SHARE * self._seen.way:
                known = (
                    "its error is unknown" if sigma is None else f"its standard deviation is {sigma:.1f} m"
                )
                self._doubt(
                    "outage",
                    f"no scan was matched for {outage.duration:.1f} s up to {self._now_s:.1f} s; the map "
                    f"goes on from the predicted pose, and {known}",
                    self._now_s - outage.duration,
                )
            lost = False
        self._seen.unmatched_since_s = unmatched if lost else None

    def _note_motion(self, result: ScanResult) -> None:
        shown = result.shown_motion
        if shown is None:
            return
        errors = self._seen.shown_errors
        noise = median(errors) if errors else 0.0
        least = max(_CONTRADICTED_M, TOLERATED_SHARE * shown.way, _SHOWN_NOISES * noise)
        errors.append(shown.error)
        if shown.error > min(least, TOLERATED_M):
            self._seen.contradictions += shown.error > TOLERATED_M
            self._doubt(
                "motion",
                f"at {self._now_s:.1f} s walls and poles show another motion than the estimated one, by "
                f"{shown.error:.1f} m: the scan match follows the scan lines, or the map is wrong",
            )

    def _note_misplaced(self, result: ScanResult) -> None:
        """Look whether anything upright stays where it is, in views that show no motion without doubt."""
        recent = self._seen.agreements
        if result.shown_motion is not None:
            recent.clear()
        if result.agreement is None:
            return
        recent.append((self._now_s, result.agreement))
        cells = sum(one.cells for _, one in recent)
        while cells - recent[0][1].cells >= _MISPLACED_CELLS:
            cells -= recent.popleft()[1].cells
        met = sum(one.met for _, one in recent)
        if cells >= _MISPLACED_CELLS and met < _MISPLACED_SHARE * cells:
            self._doubt(
                "misplaced",
                f"from {recent[0][0]:.1f} s to {self._now_s:.1f} s nothing that stands upright is where the "
                "estimated motion puts it: the scan match follows the scan lines, or all that stands there "
                "moves",
                recent[0][0],
            )

    def _note_window(self, result: ScanResult, sigma: float | None) -> None:
        output, seen = result.output, self._seen
        status = int(output.registration.status)
        seen.unconverged.append(status == ITERATION_LIMIT)
        if len(seen.unconverged) == _WINDOW and fmean(seen.unconverged) > _UNCONVERGED:
            self._doubt(
                "convergence", f"more than half of the scans around {self._now_s:.1f} s did not converge"
            )
        freedom = int(output.nis_dof)
        if freedom and status == CONVERGED:
            self._note_innovation(float(output.nis) / freedom)
        if sigma is not None and sigma > max(TOLERATED_M, TOLERATED_SHARE * seen.way):
            self._doubt("covariance", f"the position's standard deviation reached {sigma:.1f} m")
        if _is_true(output.restarted):
            self._doubt("restart", f"at {self._now_s:.1f} s velocity or biases ran away and began anew")

    def _note_innovation(self, nis: float) -> None:
        """Look for innovations that are too large in general, or much larger than before."""
        seen = self._seen
        if len(seen.nis) == _WINDOW:
            insort(seen.earlier_nis, seen.nis[0])
        seen.nis.append(nis)
        if len(seen.nis) < _WINDOW:
            return
        mean, now = fmean(seen.nis), median(seen.nis)
        enough = len(seen.earlier_nis) >= _WINDOW
        before = seen.earlier_nis[len(seen.earlier_nis) // 2] if enough else np.inf
        if mean > _LARGEST_NIS or now > max(_RAISED_NIS, _RAISED_RATIO * before):
            self._doubt(
                "innovation",
                f"around {self._now_s:.1f} s the scans contradict the prediction by inertial samples "
                f"(normalised innovation {mean:.0f} times what is expected): the surroundings may move with "
                "the sensor, as in a lift, or something that moves fills the view",
            )

    def _note_felt(self, result: ScanResult) -> None:
        """Compare the estimated motion with the one that the inertial samples feel."""
        felt, errors = result.felt_motion, self._seen.felt_errors
        if felt is None:
            return
        error = float(np.linalg.norm(felt.error))
        noise = errors[len(errors) // 2] if errors else 0.0
        insort(errors, error)
        if error > max(_FELT_M, _FELT_NOISES * noise):
            begin = (felt.start_ns - (self._first_ns or 0)) * 1e-9
            along = "upwards or downwards " if abs(felt.error[2]) > _VERTICAL * error else ""
            self._doubt(
                "felt",
                f"from {begin:.1f} s to {self._now_s:.1f} s the inertial samples feel another acceleration "
                f"{along}than the estimated one, worth {error:.1f} m: the surroundings may move with the "
                "sensor, as in a lift, or the scan match is wrong",
            )

    def _note_unobserved(self, result: ScanResult, step: float, sigma: float | None) -> None:
        output, seen = result.output, self._seen
        lost = bool(output.lost)
        weak = bool(np.asarray(output.registration.degenerate).any()) and not lost
        if not weak and not lost:
            seen.observed_s, seen.unobserved_m = self._now_s, 0.0
        seen.unobserved_m += step * weak
        if not result.has_imu and seen.unobserved_m > max(_UNOBSERVED_M, TOLERATED_SHARE * seen.way):
            self._doubt(
                "unobserved",
                f"up to {self._now_s:.1f} s the scene left a direction unobserved over "
                f"{seen.unobserved_m:.0f} m",
            )
        since_s = self._now_s - seen.observed_s
        open_by_scans = weak and not result.has_imu and since_s > _UNMEASURED_S
        if open_by_scans and sigma is not None and 3 * sigma > _UNMEASURED_M:
            self._doubt(
                "unobserved",
                f"up to {self._now_s:.1f} s no scan showed one direction of the motion for {since_s:.1f} s, "
                f"no inertial samples bridge it, and the position's standard deviation is {sigma:.1f} m",
            )
        if weak and sigma is not None and since_s > _UNOBSERVED_S and _SIGMAS * sigma > TOLERATED_M:
            self._doubt(
                "unobserved",
                f"up to {self._now_s:.1f} s no scan showed one direction of the motion for {since_s:.1f} s, "
                f"and the position's standard deviation is {sigma:.1f} m",
            )

    def _note_by_noise(self, result: ScanResult) -> None:
        """Add up the motion that the match has found in directions of which it may know noise alone.

        Where all matches leave a direction to the prediction, the covariance grows with the error. Once one
        has believed the noise, the velocity is wrong, and later predictions are. Plan views show a horizontal
        motion by themselves.
        """
        output, seen, before = result.output, self._seen, self._before
        if before is None or output.shown_by_noise is None or bool(output.lost):
            return
        rows = np.asarray(output.shown_by_noise, np.float64)
        if not rows.any():
            seen.by_noise, seen.by_noise_since_s, seen.noise_believed = np.zeros(3), self._now_s, False
            return
        seen.noise_believed |= bool(rows[~np.asarray(output.registration.degenerate)].any())
        if seen.noise_believed:
            moved = (result.T_world_imu - before.T_world_imu)[:3, 3]
            seen.by_noise = seen.by_noise + np.linalg.pinv(rows) @ (rows @ moved)
        if result.shown_motion is not None:
            seen.by_noise[:2] = 0.0
        unseen = seen.by_noise * ([1, 1, 1] if _is_true(result.motion_is_hidden) else [0, 0, 1])
        if (way := float(np.linalg.norm(unseen))) > _BY_NOISE_M:
            along = "upwards or downwards " if abs(unseen[2]) > _VERTICAL * way else ""
            self._doubt(
                "noise",
                f"from {seen.by_noise_since_s:.1f} s to {self._now_s:.1f} s the estimate moves {along}by "
                f"{way:.1f} m in a direction that no scan shows: what the map seems to tell of it may be "
                "noise alone, and neither this motion nor its standard deviation can be trusted",
            )

    def _note_hidden(self, result: ScanResult, step: float) -> None:
        """Add up the way along which nothing but the recipe's own match shows the motion."""
        seen, shown = self._seen, result.shown_motion
        if result.has_imu:
            return
        if shown is not None:
            seen.shown_step = shown.way / shown.scans
            seen.hidden_looks, seen.hidden_m, seen.hidden_since_s = 0, 0.0, self._now_s
        # a match that stays behind says that the vehicle stands; it moves on as it was seen to move
        seen.hidden_m += max(step, seen.shown_step)
        seen.hidden_looks += _is_true(result.motion_is_hidden)
        far = seen.hidden_m > max(_UNOBSERVED_M, TOLERATED_SHARE * seen.way)
        if far and seen.hidden_looks >= _HIDDEN_LOOKS:
            self._doubt(
                "unobserved",
                f"from {seen.hidden_since_s:.1f} s on nothing upright shows the motion, as in a tunnel or on "
                "a plain, and no inertial samples bridge it",
                seen.hidden_since_s,
            )

    def _note_jumps(self, result: ScanResult) -> None:
        """Look for accelerations that no vehicle has."""
        before, seen, output = self._before, self._seen, result.output
        interval = (result.stamp_ns - before.stamp_ns) * 1e-9 if before is not None else 0.0
        restarts = _is_true(output.restarted) or _is_true(output.new_piece) or bool(output.lost)
        if before is None or interval <= 0 or restarts:
            seen.last = None
            seen.accelerations.clear()
            return
        last, step = seen.last, (result.T_world_imu - before.T_world_imu)[:3, 3]
        seen.last = step, interval
        if last is None:
            return
        # some recorders stamp equal sweeps unequally: what is steady by stamps or by count is no jump
        by_stamps = np.linalg.norm(step / interval - last[0] / last[1]) / interval
        evenly = np.linalg.norm(step - last[0]) / (interval * last[1])
        seen.accelerations.append(float(min(by_stamps, evenly)))
        full = len(seen.accelerations) == _ROUGH_SCANS
        rough = median(seen.accelerations) if full else 0.0
        if seen.accelerations[-1] > _STRONGEST or rough > _ROUGHEST:
            self._doubt(
                "jumps",
                f"at {self._now_s:.1f} s the estimated motion jumps by accelerations of "
                f"{max(seen.accelerations):.0f} m/s^2: the scan match is wrong",
            )


def _is_true(flag: Any) -> bool:
    return flag is not None and bool(flag)


def in_words(verdict: dict[str, Any]) -> str:
    """Return a verdict of metrics.json in a few words."""
    since = verdict["since_s"]
    return verdict["state"] + (f" from {since:.1f} s on" if since is not None else "")


def _sigma(covariance: NDArray[np.float64] | None) -> float | None:
    """Return the largest standard deviation of the position over all directions, m."""
    return None if covariance is None else largest_sigma(np.asarray(covariance)[3:6, 3:6])
