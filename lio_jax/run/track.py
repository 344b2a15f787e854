"""Feed scans through a recipe's step, one by one, and bring each result back to the host."""

import time
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.types import Scan
from lio_jax.data.sequence import LidarScan, prefetched
from lio_jax.data.trajectory import pose_matrices
from lio_jax.recipes.transforms import Stepper, reopened
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.failures import BridgedOutage, OutageWatch, ScanEvidence, failure_of, longest_gap
from lio_jax.run.feedback import Feedback
from lio_jax.run.felt_motion import FeltMotion, FeltMotionCheck
from lio_jax.run.journal import Journal
from lio_jax.run.paging import Pager
from lio_jax.run.scan_inputs import ImuFeed, InputsInTurn, ScanInput
from lio_jax.run.shown_motion import Agreement, MotionCheck, ShownMotion
from lio_jax.settings.settings import Settings


@dataclass(frozen=True)
class ScanResult:
    """One scan's result on the host."""

    index: int
    """Position among the tracked scans."""
    stamp_ns: int
    """The scan's end: the instant of ``T_world_imu``."""
    T_world_imu: NDArray[np.float64]
    """(4, 4)."""
    nav: Any
    """The whole navigation state, numpy leaves."""
    output: Any
    """The recipe's output, still on the device."""
    scan_points: int
    """Points of the scan as it was recorded."""
    stage_ms: dict[str, float]
    """pad: copying into padded arrays; step: transfer, estimation and the way back; total: their sum."""
    failure: str
    """What went wrong with this scan, or nothing."""
    duration: float = 0.0
    """Time from the scan's first to its last point, s; 0 where it is compensated already."""
    beams: int | None = None
    """Number of beams, each at an elevation of its own; 0 where rings are unknown or no such beams, and None
    where they were not counted."""
    shown_motion: ShownMotion | None = None
    """What plan views show of the motion since an earlier scan; None where it was not compared."""
    motion_is_hidden: bool | None = None
    """Whether that comparison shows no motion without doubt; None where nothing was compared."""
    agreement: Agreement | None = None
    """Where it shows none and the estimate moves little: how much of what stands upright stays in place."""
    felt_motion: FeltMotion | None = None
    """How the estimated motion differs from what inertial samples feel; None where it was not compared."""
    has_imu: bool = False
    """Whether inertial samples predicted the pose."""
    outage: BridgedOutage | None = None
    """The outage after which a new piece of map begins with this scan."""
    raw: NDArray[np.float32] | None = None
    """(k, 3) some of the points as recorded, m in the lidar frame of their own firing, for pictures."""
    T_map_odom: NDArray[np.float64] | None = None
    """(4, 4) pose of the odometry's world in the corrected map that the scan was matched with, m; None
    without feedback."""
    fed: ScanInput | None = None
    """The scan as the step took it, with all its points; None where ``config.output.clouds`` is "none"."""


def track(
    settings: Settings,
    scans: Iterable[LidarScan],
    imu: ImuFeed | None = None,
    step: CompiledStep | None = None,
    journal: Journal | None = None,
    feedback: Feedback | None = None,
) -> Generator[ScanResult]:
    """Yield the result of each scan in turn, each while the step of the next scan runs.

    What the host does with a result, here and where it is taken, thus costs no time of its own unless it
    takes longer than a step. After an error or Ctrl-C the result that was kept back is yielded first.

    Args:
        settings: recipe, config and params.
        scans: in time order.
        imu: inertial samples; None where there are none or the recipe is to do without.
        step: of the same settings; None: a new one. It tells how long compiling took.
        journal: gives back the steps of a killed run, which are not computed again, and stores the others.
        feedback: of ``step``; corrects the state between scans. Results lie in the frame of the odometry.
    """
    step = step or CompiledStep(settings)
    judged, pager = ResultBuilder(settings), step.pager()
    held: tuple[Any, ...] | None = None
    # closing: whoever stops early must not leave the decoding thread and its files behind
    with ThreadPoolExecutor(1) as reader, closing(scan_inputs(settings, scans, imu)) as inputs:
        for fed, nav, output, step_ms in journal.replayed(step, inputs) if journal else ():
            T_map_odom = None
            if feedback is not None:
                feedback.applied(None, fed.index, pager)
                feedback.take(fed.end_ns, output)
            if pager is not None:
                pager.take(output)
            if feedback is not None:
                T_map_odom, nav, output = feedback.in_odometry(nav, output)
            yield judged(fed, nav, output.registration, output, step_ms, T_map_odom)
        compiled_s = step.compile_s
        try:
            for fed, state, output in run_steps(
                step, inputs, journal.state if journal else None, pager, feedback
            ):
                reading = reader.submit(on_host, state.nav, output.registration)
                compiled_in_step_s, compiled_s = step.compile_s - compiled_s, step.compile_s
                if held is not None:
                    last, held = held, None
                    yield judged(*last)
                nav, registration, read_at = reading.result()
                step_ms = (read_at - fed.begun_at - compiled_in_step_s) * 1e3
                if journal is not None:
                    journal.add(fed, nav, output, step_ms, state if fed.usable else None)
                T_map_odom = None
                if feedback is not None:
                    output = replace(output, registration=registration)
                    T_map_odom, nav, output = feedback.in_odometry(nav, output)
                    registration = output.registration
                held = fed, nav, registration, output, step_ms, T_map_odom
        except (KeyboardInterrupt, Exception):
            if held is not None:
                yield judged(*held)
            raise
        if held is not None:
            yield judged(*held)


def on_host(nav: Any, registration: Any) -> tuple[Any, Any, float]:
    """Return copies with numpy leaves, and the host time when they were there, s."""
    nav, registration = jax.tree.map(np.array, (nav, registration))
    return nav, registration, time.perf_counter()


class ResultBuilder:
    """Puts each scan's result together with what went wrong with it."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._before: ScanEvidence | None = None
        self._check = MotionCheck()
        self._felt = FeltMotionCheck()
        self._outages = OutageWatch()

    def __call__(
        self,
        fed: ScanInput,
        nav: Any,
        registration: Any,
        output: Any,
        step_ms: float,
        T_map_odom: NDArray[np.float64] | None = None,
    ) -> ScanResult:
        """Return the result of a scan; ``nav`` and ``registration`` have numpy leaves."""
        evidence = ScanEvidence(
            points=fed.count,
            covered=fed.covered,
            nav=nav,
            registration=registration,
            lost=bool(output.lost),
            nis=float(output.nis),
            since_last_s=float(fed.scan.interval),
            features=_few_features(output),
            new_piece=output.new_piece is not None and bool(output.new_piece),
            restarted=output.restarted is not None and bool(output.restarted),
            smoother_unfinished=output.smoother_unfinished is not None and bool(output.smoother_unfinished),
            imu_gap_s=_imu_gap(fed.imu, fed.scan, nav) if fed.imu else None,
        )
        failure = failure_of(evidence, self._before, self._settings)
        self._before = evidence
        T_world_imu = pose_matrix(nav.T_world_imu.wxyz_xyz)
        T_world_lidar = pose_matrix(registration.T_world_lidar.wxyz_xyz)
        unmatched = evidence.lost or not fed.usable
        look = self._check(fed.index, fed.scan, T_world_lidar, unmatched)
        breaks = unmatched or evidence.new_piece or evidence.restarted or bool(registration.degenerate.any())
        return ScanResult(
            index=fed.index,
            stamp_ns=fed.end_ns,
            T_world_imu=T_world_imu,
            nav=nav,
            output=output,
            scan_points=fed.count,
            stage_ms={"pad": fed.pad_ms, "step": step_ms, "total": fed.pad_ms + step_ms},
            failure=failure,
            duration=float(fed.scan.duration),
            beams=None if fed.index % _BEAMS_EVERY else beams_of(fed.scan),
            shown_motion=look.shown,
            motion_is_hidden=look.is_hidden,
            agreement=look.agreement,
            felt_motion=self._felt(fed.end_ns, fed.scan, fed.imu, nav, T_world_imu, breaks),
            has_imu=fed.imu is not None,
            outage=self._outages(fed.end_ns, evidence, output.covariance),
            raw=_some(np.asarray(fed.scan.points)[: fed.count]),
            T_map_odom=T_map_odom,
            fed=None if self._settings.run.output.clouds == "none" else fed,
        )


def scan_inputs(settings: Settings, scans: Iterable[LidarScan], imu: ImuFeed | None) -> Generator[ScanInput]:
    """Yield each scan in padded arrays, with the inertial samples that cover it.

    ``config.data.prefetch`` of them are decoded and padded ahead on a thread, which ends when the generator
    is closed.
    """
    in_turn = InputsInTurn(settings, imu)
    return prefetched((in_turn(scan) for scan in scans), settings.run.data.prefetch)


class StepsInTurn:
    """Takes scans through a stepper, one at a time.

    The result of the first usable scan comes with that of the second one, because only the second scan shows
    how fast the vehicle was.
    """

    def __init__(
        self,
        stepper: Stepper,
        state: Any = None,
        pager: Pager | None = None,
        feedback: Feedback | None = None,
    ) -> None:
        """Begin a run.

        Args:
            stepper: of the run.
            state: after a usable scan before the first one here; it is consumed. None: the run is new.
            pager: hands parts of the map over; it has taken the outputs of the scans before the first one
                here. None: what a recipe has no more room for is lost.
            feedback: corrects the state between scans; it has taken the same outputs as the pager. None:
                nothing is corrected.
        """
        self._stepper, self._pager, self._feedback = stepper, pager, feedback
        self._last: tuple[ScanInput, Any] | None = None
        self._state = state
        self._opened = state is not None
        self._held: tuple[ScanInput, Any, Any] | None = None

    def take(self, fed: ScanInput) -> Iterator[tuple[ScanInput, Any, Any]]:
        """Yield scans with the state and the output after each; a state is consumed when the next is asked
        for."""
        state = self._between(fed)
        if self._held is not None:
            first, state, output = self._held
            self._held = None
            if fed.usable:
                first = replace(first, begun_at=time.perf_counter())
                state, output = reopened(self._stepper, state, output, first, fed)
            self._remember(first, output)
            yield first, state, output
        fed = replace(fed, begun_at=time.perf_counter())
        begins = fed.usable and not self._opened
        if state is None or begins:
            state = self._stepper.init(fed.before)
        self._state, output = self._stepper.step(state, fed.scan, fed.imu)
        self._last = fed, output
        if begins:
            self._held, self._opened = (fed, self._state, output), True
        else:
            yield fed, self._state, output

    def _between(self, fed: ScanInput) -> Any:
        """Return the state before a scan, with its keyframes corrected and with what the pager hands over."""
        state = self._state
        if self._held is not None or state is None:
            return state
        if self._last is not None:
            self._remember(*self._last)
        if self._feedback is not None:
            state = self._feedback.applied(state, fed.index, self._pager)
        return state if self._pager is None else self._pager.paged(state)

    def _remember(self, fed: ScanInput, output: Any) -> None:
        if self._feedback is not None:
            self._feedback.take(fed.end_ns, output)
        if self._pager is not None:
            self._pager.take(output)

    def rest(self) -> Iterator[tuple[ScanInput, Any, Any]]:
        """Yield the first usable scan where no other one came after it."""
        if self._held is not None:
            held, self._held = self._held, None
            yield held


def run_steps(
    stepper: Stepper,
    scan_inputs: Iterable[ScanInput],
    state: Any = None,
    pager: Pager | None = None,
    feedback: Feedback | None = None,
) -> Iterator[tuple[ScanInput, Any, Any]]:
    """Yield each scan with the state and the output after it; the state is consumed by the next one.

    After an error or Ctrl-C the result that was kept back is yielded first.

    Args:
        stepper: of the run.
        scan_inputs: in time order.
        state: after a usable scan before these, from which to go on; it is consumed. None: these are the
            first ones.
        pager: hands parts of the map over, see :class:`StepsInTurn`.
        feedback: corrects the state between scans, see :class:`StepsInTurn`.
    """
    steps = StepsInTurn(stepper, state, pager, feedback)
    try:
        for fed in scan_inputs:
            yield from steps.take(fed)
    except (KeyboardInterrupt, Exception):
        yield from steps.rest()
        raise
    yield from steps.rest()


_BEAMS_EVERY = 50
"""Number of scans from one count of the beams to the next."""
_NARROW = 0.02
"""Half of the points of a beam lie within this elevation, rad; the lines of a Livox swing."""


def beams_of(scan: Scan) -> int:
    """Return the number of rings of a scan; 0 where they are unknown or swing in elevation."""
    mask = np.asarray(scan.mask) & (np.asarray(scan.ring) >= 0)
    ring, points = np.asarray(scan.ring)[mask][::_EVERY_POINT], np.asarray(scan.points)[mask][::_EVERY_POINT]
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    numbers = np.unique(ring)
    spreads = [np.subtract(*np.percentile(elevation[ring == number], [75, 25])) for number in numbers]
    return len(numbers) if len(numbers) and np.median(spreads) < _NARROW else 0


_EVERY_POINT = 7
"""One point of so many is looked at for the beams: no divisor of their number, or some would be left out."""


_SHOWN_POINTS = 5000


def _some(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a copy of a few thousand points: whoever keeps results must not keep whole scans by them."""
    return points[:: max(1, len(points) // _SHOWN_POINTS)].copy()


def pose_matrix(wxyz_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the 4x4 matrix of a quaternion (w first) and a translation; NaN gives NaN."""
    return pose_matrices(wxyz_xyz[None, 4:], wxyz_xyz[None, [1, 2, 3, 0]])[0]


def _few_features(output: Any) -> tuple[int, int] | None:
    """Return the number of corners and of surface points where they are too few for a match."""
    if output.too_few_features is None or not bool(output.too_few_features):
        return None
    real, corners = np.asarray(output.points_mask), np.asarray(output.corners)
    return int(np.count_nonzero(real & corners)), int(np.count_nonzero(real & ~corners))


def _imu_gap(samples: Any, scan: Any, nav: Any) -> float:
    """Return the longest time without an inertial sample since the last scan's end, s."""
    end = float(scan.duration) + float(nav.time_offset)
    return longest_gap(samples, end - float(scan.interval or scan.duration), end)
