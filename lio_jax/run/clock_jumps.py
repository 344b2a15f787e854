"""Find jumps of the IMU's clock before a run, and take them out of the stamps.

The stamps show where something happened and by how much. They do not show whether samples are missing, or the
clock jumped and all later stamps are wrong by the same time. The scans decide it. LiDAR odometry runs over
windows before and behind such a place. The gyroscope and the accelerometer have to explain its poses, once
with the stamps as they are and once with the jump taken out.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.types import CONVERGED
from lio_jax.data.imu_checks import cleaned
from lio_jax.data.sequence import ImuData, LidarScan, Sequence
from lio_jax.run.fitted_settings import fitted_to_surroundings
from lio_jax.run.set_up_fit import Poses, Samples, SetUp, fitted
from lio_jax.run.track import track
from lio_jax.settings.settings import Settings, recipe_settings

_LEAST_S, _LARGEST_S = 0.008, 3.0
"""Sizes of steps that are looked at, s: a smaller one does no harm, and a larger one is a gap."""
_MOST_STEPS = 6
"""Where there are more, samples are missing all over, or stamps jitter."""
_CLEAR = 10.0
"""Difference of the logarithms of the likelihoods that decides. Residuals are correlated, so it is large."""
_CLOCK_SIGMA_S = 0.01
"""Standard deviation of the clock that was assumed, s. It decides where nothing moved before a step."""
_ITERATIONS = 3
_WINDOW_S, _WARM_UP_S = 2.0, 0.5
"""Length of a window, and of the odometry before it, s."""
_WINDOWS = 2
"""Number of windows on each side of a step: those in which the angular rate varies most."""
_REACH_S = 60.0
"""A window is at most this far from its step, s."""
_FEWEST_POSES = 8
_THINNED_TO = 16384
"""Number of points of a scan that the odometry takes."""


class ClockStep(NamedTuple):
    """A place where the stamps do not follow each other regularly."""

    after: int
    """Sample after which it lies, in recorded order."""
    size_ns: int
    """Time by which the next stamp is later than usual; negative: earlier."""


def without_clock_jumps(
    sequence: Sequence, settings: Settings, recorded: ImuData
) -> tuple[ImuData, tuple[str, ...]]:
    """Return the samples with the stamps behind each jump of the clock moved back, and a sentence on each.

    A jump of less than 8 ms or more than 3 s is not looked for, nor are jumps among more than six irregular
    intervals. Where the scans do not decide, for example because the vehicle stands, the stamps stay.

    Args:
        sequence: the recording; some of its scans are read.
        settings: of the run; their extrinsic and time offset hold.
        recorded: samples in recorded order, before any is dropped.
    """
    steps = clock_steps(recorded)
    if not steps:
        return recorded, ()
    extrinsics = settings.values["extrinsics"]
    assumed = SetUp(
        Rotation.from_quat(extrinsics["rotation"]),
        np.array(extrinsics["translation"], np.float64),
        float(extrinsics["time_offset"]),
    )
    odometry = _Odometry(sequence)
    origin_ns, sentences = int(recorded.stamp_ns[0]), []
    for step, following in pairwise([*steps, None]):
        assert step is not None
        end = len(recorded.stamp_ns) if following is None else following.after + 1
        corrected = _moved_back(recorded, step)
        hypotheses = [cleaned(imu, "IMU")[0] for imu in (recorded, corrected)]
        if not _explained_by_jump(odometry, hypotheses, _windows(corrected, step, end), assumed):
            continue
        at = (int(recorded.stamp_ns[step.after]) - origin_ns) * 1e-9
        sentences.append(
            f"IMU: its clock jumped by {step.size_ns * 1e-9:+.3f} s at {at:.3f} s, as the scans show: the "
            "stamps of all later samples are moved back by that."
        )
        recorded = corrected
    return recorded, tuple(sentences)


def clock_steps(imu: ImuData) -> list[ClockStep]:
    """Return the places where the clock may have jumped; none where there are many.

    Args:
        imu: samples in recorded order.
    """
    if len(imu.stamp_ns) < 3:
        return []
    intervals = np.diff(imu.stamp_ns)
    usual = int(np.median(intervals))
    sizes = intervals - usual
    irregular = (np.abs(sizes) > max(_LEAST_S * 1e9, usual / 2)) & (np.abs(sizes) < _LARGEST_S * 1e9)
    at = np.flatnonzero(irregular)
    if len(at) > _MOST_STEPS:
        return []
    return [ClockStep(int(one), int(sizes[one])) for one in at if not _is_sent_again(imu, int(one) + 1)]


def _is_sent_again(imu: ImuData, index: int) -> bool:
    """Return whether a sample is an earlier one once more, with its stamp."""
    same = np.flatnonzero(imu.stamp_ns[:index] == imu.stamp_ns[index])
    return bool(np.any(np.all(imu.gyro[same] == imu.gyro[index], axis=1)))


def _moved_back(imu: ImuData, step: ClockStep) -> ImuData:
    later = np.arange(len(imu.stamp_ns)) > step.after
    return replace(imu, stamp_ns=imu.stamp_ns - np.where(later, step.size_ns, 0))


def _windows(imu: ImuData, step: ClockStep, end: int) -> list[int]:
    """Return the starts of the windows in ns, those with the most variable rates on either side of a step.

    Args:
        imu: samples with the jump taken out.
        step: the place.
        end: number of samples before the next step.
    """
    length, grid = round(_WINDOW_S * 1e9), round(_WINDOW_S * 1e9) // 4
    away, origin = abs(step.size_ns) + round(0.1e9), int(imu.stamp_ns[0])
    at = int(imu.stamp_ns[step.after])
    first = max(int(imu.stamp_ns[0]), at - round(_REACH_S * 1e9))
    last = min(int(imu.stamp_ns[end - 1]), at + round(_REACH_S * 1e9))
    found = []
    for low, high in ((first, at - away), (at + away, last - away)):
        # on a grid, so that neighbouring steps share windows
        starts = np.arange(low + (origin - low) % grid, high - length, grid)
        bounds = [np.searchsorted(imu.stamp_ns[:end], (start, start + length)) for start in starts]
        varied = [_variation(imu.gyro[one:other]) for one, other in bounds]
        best = np.argsort(varied)[::-1]
        found += starts[best[:1]].tolist()
        apart = [one for one in best[1:] if abs(starts[one] - starts[best[0]]) >= length]
        found += starts[apart[: _WINDOWS - 1]].tolist()
    return found


def _variation(gyro: NDArray[np.float64]) -> float:
    return float(np.sum(np.std(gyro, axis=0))) if len(gyro) else 0.0


def _explained_by_jump(
    odometry: "_Odometry", hypotheses: list[ImuData], starts: list[int], assumed: SetUp
) -> bool:
    """Return whether the scans show clearly that the clock jumped.

    Args:
        odometry: of the recording.
        hypotheses: samples as recorded, and with the jump taken out.
        starts: of the windows, ns on the IMU's clock with the jump taken out.
        assumed: extrinsic and clock.
    """
    origin_ns = int(hypotheses[0].stamp_ns[0])
    offset_ns = round(assumed.time_offset * 1e9)
    windows = [odometry.poses(start - offset_ns, origin_ns) for start in starts]
    known = [poses for poses in windows if poses is not None]
    costs = []
    for imu in hypotheses:
        seconds = np.asarray((imu.stamp_ns - origin_ns) * 1e-9, np.float64)
        # the clock itself may be off by an unknown time on both sides
        fit = fitted(known, Samples(seconds, imu.gyro, imu.accel), assumed, _ITERATIONS, ("clock",))
        if fit is None:
            return False
        late = fit[0].time_offset - assumed.time_offset
        costs.append(fit[1].cost + (late / _CLOCK_SIGMA_S) ** 2 / 2)
    return costs[0] - costs[1] > _CLEAR


class _Odometry:
    """LiDAR odometry over short windows of a recording."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        settings, _ = fitted_to_surroundings(sequence, recipe_settings("default"))
        settings = settings.with_value("config.imu.use", False, "clock")
        settings = settings.with_value("config.lidar.buckets", [_THINNED_TO], "clock")
        settings = settings.with_value("params.extrinsics.rotation", [0.0, 0.0, 0.0, 1.0], "clock")
        self._settings = settings.with_value("params.extrinsics.translation", [0.0, 0.0, 0.0], "clock")
        self._known: dict[int, Poses | None] = {}

    def poses(self, start_ns: int, origin_ns: int) -> Poses | None:
        """Return the lidar's poses in a window; None where there are too few scans or a match failed.

        Args:
            start_ns: of the window, on the lidar's clock.
            origin_ns: origin of the poses' times.
        """
        if start_ns not in self._known:
            self._known[start_ns] = self._found(start_ns, origin_ns)
        return self._known[start_ns]

    def _found(self, start_ns: int, origin_ns: int) -> Poses | None:
        first = self._index_at(start_ns - round(_WARM_UP_S * 1e9))
        if first is None:
            return None
        scans = list(self._until(first, start_ns + round(_WINDOW_S * 1e9)))
        rows = []
        for scan, result in zip(scans, track(self._settings, scans), strict=True):
            middle = scan.stamp_ns + round(scan.duration / 2 * 1e9)
            if middle < start_ns:
                continue
            if result.failure or int(result.output.registration.status) != CONVERGED:
                return None
            pose = np.asarray(result.output.registration.T_world_lidar.wxyz_xyz, np.float64)
            rows.append(((middle - origin_ns) * 1e-9, pose))
        if len(rows) < _FEWEST_POSES:
            return None
        wxyz_xyz = np.array([pose for _, pose in rows])
        rotations = Rotation.from_quat(wxyz_xyz[:, :4], scalar_first=True).as_matrix()
        return Poses(np.array([seconds for seconds, _ in rows]), rotations, wxyz_xyz[:, 4:])

    def _until(self, first: int, end_ns: int) -> Iterator[LidarScan]:
        for scan in self._sequence.scans(first):
            if scan.end_ns > end_ns:
                return
            yield scan

    def _index_at(self, stamp_ns: int) -> int | None:
        """Return the first scan that begins at a time or later, by bisection; None where there is none."""
        low, high = 0, self._sequence.info.scan_count
        while low < high:
            middle = (low + high) // 2
            scan = next(iter(self._sequence.scans(middle, 1)), None)
            if scan is None:
                return None
            low, high = (middle + 1, high) if scan.stamp_ns < stamp_ns else (low, middle)
        return low if low < self._sequence.info.scan_count else None
