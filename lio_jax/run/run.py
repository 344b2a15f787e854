"""Run a recipe over a recording and leave a run folder behind, whatever happens on the way."""

import resource
import sys
import time
from collections.abc import Callable, Generator, Iterator
from collections.abc import Sequence as Listing
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.detect import without_effect
from lio_jax.data.imu_checks import cleaned
from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.run.clock_jumps import without_clock_jumps
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.feedback import Feedback
from lio_jax.run.fitted_settings import (
    fitted_to_surroundings,
    notes_on_rings,
    with_inertial_noise,
    with_point_order,
    with_range_noise,
    with_sensor_sizes,
)
from lio_jax.run.folder import environment, write_json
from lio_jax.run.global_correction import GlobalCorrection
from lio_jax.run.journal import Journal
from lio_jax.run.localise import LocalisingStep, step_of
from lio_jax.run.logs import Failures, Overflow, ScanLog, StageTimes, TrajectoryLog
from lio_jax.run.map_file import MapFile
from lio_jax.run.scan_clouds import ScanClouds
from lio_jax.run.scan_inputs import ImuFeed, feed_of
from lio_jax.run.set_up_check import SetUpCheck
from lio_jax.run.sinks import RunResult, Sink, finish_all
from lio_jax.run.state_files import ImuRateFile, StateFiles
from lio_jax.run.track import ScanResult, track
from lio_jax.run.verdict import Verdict
from lio_jax.settings.settings import Settings, uses_imu, with_extrinsics


def settings_for(sequence: Sequence, settings: Settings) -> tuple[Settings, list[str]]:
    """Take from the recording what was not given, and say so: calibration, sizes, noise, order of points."""
    settings, calibration = _calibrated(sequence, settings)
    settings, fitted = fitted_to_surroundings(sequence, settings)
    settings, noise = with_inertial_noise(sequence, settings)
    settings, ranges = with_range_noise(settings, sequence.scans())
    settings, order = with_point_order(settings, sequence.scans())
    settings, sizes = with_sensor_sizes(settings, sequence.scans())
    rings = notes_on_rings(settings, sequence.scans())
    unused = [
        f"config.data.{name} has no effect on a recording of the format {sequence.info.format}; leave it out."
        for name in without_effect(sequence.info.format, settings.run.data)
    ]
    return settings, [calibration, *fitted, *noise, *ranges, *order, *sizes, *rings, *unused]


def _calibrated(sequence: Sequence, settings: Settings) -> tuple[Settings, str]:
    given = any(
        path.startswith(("params.extrinsics.rot", "params.extrinsics.trans")) for path in settings.given
    )
    if given:
        unused = "" if sequence.info.T_imu_lidar is None else "; the recording's calibration is not used"
        return settings, f"T_imu_lidar: as given in the settings{unused}."
    if sequence.info.T_imu_lidar is None:
        return settings, "T_imu_lidar: not in the recording; taken as identity (set params.extrinsics.*)."
    settings = with_extrinsics(settings, sequence.info.T_imu_lidar, sequence.info.path)
    return settings, "T_imu_lidar: from the recording's calibration."


def run_sequence(
    sequence: Sequence,
    settings: Settings,
    out: Path,
    start: int = 0,
    count: int | None = None,
    sinks: Listing[Sink] = (),
    notify: Callable[[str], None] | None = None,
    journal: Journal | None = None,
) -> RunResult:
    """Estimate the recording's trajectory and map, and write the run folder's files.

    An error or Ctrl-C in the middle ends the run; what was computed until then is written all the same.
    With a journal, a run whose process was killed goes on from its last checkpoint:

        with opened_journal(out, sequence, settings) as journal:
            run_sequence(sequence, settings, out, journal=journal)

    Args:
        sequence: the recording.
        settings: recipe, config and params, the extrinsics resolved.
        out: the run folder; it is made if it does not exist.
        start: first scan.
        count: number of scans; None: to the end.
        sinks: your own, derived from :class:`lio_jax.Sink`: each takes every scan's result after the run's
            own sinks, and finishes after them, when their files are written. What it raises in ``take`` ends
            the run early; what it raises in ``finish`` costs its own results alone.
        notify: takes each sentence on a fault of the set-up as soon as it is known, and where the run begins
            in a known map.
        journal: of this run (:func:`lio_jax.run.journal.opened_journal`). All sinks take every scan of a
            resumed run, once, as those of a run that was never killed. ``result.output`` of a scan before the
            checkpoint has numpy leaves. None: the run cannot be resumed.

    Raises:
        UsageError: the recording ends before ``start``.
        LioJaxError: no scan could be read.
    """
    with ExitStack() as stack:
        for sink in sinks:
            stack.callback(sink.close)
        check_start(sequence, start)
        out.mkdir(parents=True, exist_ok=True)
        began = time.perf_counter()
        imu, imu_notes = imu_feed(sequence, settings)
        step = step_of(sequence, settings, imu.samples if imu else None, start)
        feedback = _feedback(step, settings)
        if isinstance(step, LocalisingStep) and notify is not None:
            notify(f"note: {step.start}")
        log, times = TrajectoryLog(), StageTimes("decode", "pad", "step", "record", "total")
        # the log last: wherever Ctrl-C comes, the others have every scan that it has
        everyone: list[Sink] = [times, Overflow(settings), Failures(start)]
        everyone += [SetUpCheck(settings, imu.samples if imu else None, notify), Verdict(settings)]
        everyone += [ScanLog(out / "scans.npz", start), log]
        for sink in _result_files(sequence, settings, out, start, imu, log, feedback):
            stack.callback(sink.close)
            everyone.append(sink)
        everyone += sinks
        scans = _timed(sequence.scans(start, count), times.ms["decode"])
        interruption: BaseException | None = None
        try:
            # closing: a sink that raises must not leave the decoding thread and its files behind
            with closing(scans), closing(track(settings, scans, imu, step, journal, feedback)) as results:
                _hand_out(results, everyone, times.ms["record"])
        except (KeyboardInterrupt, Exception) as error:
            interruption = error
        if not len(log):
            raise interruption or nothing_read(sequence)
        metrics = {"recording": _described(sequence), **prediction(sequence, imu, imu_notes)}
        if journal is not None:
            metrics["warnings"] += journal.warnings()
            metrics |= {"resumed_at_scan": start + journal.scans} if journal.scans else {}
        if isinstance(step, LocalisingStep):
            metrics["start_in_known_map"] = step.start.as_dict()
        run = RunResult(metrics=metrics, interruption=interruption)
        finish_all(everyone, run)
    run.metrics |= {
        "compile_s": round(step.compile_s, 4),
        "wall_s": round(time.perf_counter() - began, 4),
        "peak_rss_mb": round(peak_rss_mb(), 1),
        "environment": environment(),
    }
    write_json(out / "metrics.json", run.metrics)
    return run


def _feedback(step: CompiledStep, settings: Settings) -> Feedback | None:
    """Return the way of corrections into the odometry; None where they are not wanted there.

    Raises:
        UsageError: there are no corrections, or the recipe takes none.
    """
    backend = settings.run.backend
    if not backend.feedback:
        return None
    if not (backend.loops or backend.gps):
        raise UsageError(
            "config.backend.feedback=true has no effect without corrections; add config.backend.loops=true "
            "or config.backend.gps=true."
        )
    return step.feedback()


def _result_files(
    sequence: Sequence,
    settings: Settings,
    out: Path,
    start: int,
    imu: ImuFeed | None,
    log: TrajectoryLog,
    feedback: Feedback | None,
) -> Iterator[Sink]:
    """Yield the sinks that write a run's results, in the order in which they finish."""
    files = StateFiles(out, settings, log)
    yield files
    if settings.run.backend.loops or settings.run.backend.gps:
        yield GlobalCorrection(sequence, settings, out, files, feedback)
    elif settings.run.output.map:
        yield MapFile(out / "map.pcd")
    if settings.run.output.clouds != "none":
        yield ScanClouds(out, settings, start)
    if imu and imu.samples:
        yield ImuRateFile(out / "imu_rate.tum", imu.samples, log)


def _hand_out(results: Iterator[ScanResult], sinks: Listing[Sink], record_ms: list[float]) -> None:
    for result in results:
        began = time.perf_counter()
        for sink in sinks:
            sink.take(result)
        record_ms.append((time.perf_counter() - began) * 1e3)


def nothing_read(sequence: Sequence) -> LioJaxError:
    """Return the error of a recording without a readable scan."""
    reasons = " ".join(sequence.warnings_so_far)
    return LioJaxError(f"{sequence.info.path}: no scan could be read. {reasons}".strip())


def prediction(sequence: Sequence, imu: ImuFeed | None, imu_notes: Listing[str]) -> dict[str, Any]:
    """Return the metrics of what predicted the motion, and the warnings so far.

    Args:
        sequence: read to its end.
        imu: what it was fed from; None without inertial samples.
        imu_notes: what was found wrong with them before.
    """
    return {
        "prediction": "inertial samples" if imu else "constant velocity",
        "warnings": [*sequence.warnings_so_far, *imu_notes, *(imu.warnings() if imu else ())],
    }


def imu_feed(sequence: Sequence, settings: Settings) -> tuple[ImuFeed | None, tuple[str, ...]]:
    """Return the recording's inertial samples, checked, and what was found wrong with them.

    None where the recording holds none or ``config.imu.use`` is false: the recipe then does without.
    """
    if not uses_imu(settings):
        return None, ()
    recorded = sequence.imu()
    if recorded is None or not len(recorded.stamp_ns):
        return None, ()
    recorded, jumps = without_clock_jumps(sequence, settings, recorded)
    imu, found = cleaned(recorded, "IMU", sequence.info.T_imu_lidar)
    return feed_of(imu, settings), jumps + found


def _described(sequence: Sequence) -> dict[str, Any]:
    info = sequence.info
    return {
        "name": info.name,
        "path": info.path,
        "format": info.format,
        "sensor": info.sensor,
        "notes": list(info.notes),
    }


def check_start(sequence: Sequence, start: int) -> None:
    """Refuse a first scan that lies behind the recording's end.

    Raises:
        UsageError: it does; the sentence says how many scans there are.
    """
    info = sequence.info
    if start >= info.scan_count > 0:
        raise UsageError(
            f"{info.path}: holds {info.scan_count} scans, numbered from 0, so none from {start} on; "
            f"start at {info.scan_count - 1} or before."
        )


def peak_rss_mb() -> float:
    """Return the largest resident memory the process has had, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)


def _timed(scans: Iterator[LidarScan], decode_ms: list[float]) -> Generator[LidarScan]:
    while True:
        start = time.perf_counter()
        scan = next(scans, None)
        if scan is None:
            return
        decode_ms.append((time.perf_counter() - start) * 1e3)
        yield scan
