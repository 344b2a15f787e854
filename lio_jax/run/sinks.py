"""What a run hands its results to: each sink takes every scan's result, and finishes once at the end."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.trajectory import Trajectory
from lio_jax.run.track import ScanResult


def _no_poses() -> Trajectory:
    return Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))


@dataclass
class RunResult:
    """What a run computed; its sinks fill it in one after another."""

    trajectory: Trajectory = field(default_factory=_no_poses)
    """T_world_imu at the scans' ends, corrected where there is a back end."""
    metrics: dict[str, Any] = field(default_factory=lambda: {"warnings": []})
    """What metrics.json holds."""
    stage_ms: dict[str, list[float]] = field(default_factory=dict)
    """Time of each stage for each scan."""
    map_points: NDArray[np.float32] | None = None
    """(n, 3) m in world; None where no map was asked for."""
    odometry: Trajectory | None = None
    """As it was before the back end corrected it; None without one."""
    interruption: BaseException | None = None
    """What ended the run early; else the first error of a sink that could not finish."""
    unfinished: list[Exception] = field(default_factory=list)
    """The errors of the sinks that could not finish, in their order."""


class Sink:
    """Takes every scan's result of a run. Derive from it and define the methods that are needed."""

    def take(self, result: ScanResult) -> None:
        """Take one scan's result, in the order of the scans; an exception ends the run.

        Args:
            result: ``result.output`` lies on the device; copy what is kept of it.
        """

    def finish(self, run: RunResult) -> None:
        """Write what is written at the end; add metrics (JSON values) and warnings to ``run.metrics``.

        This is called once after the last scan, also where an error or Ctrl-C ended the run, but not where no
        scan had a result. An exception costs the results of this sink alone.

        Args:
            run: what the sinks before this one found.
        """

    def close(self) -> None:
        """Release files and threads; this is called last, whatever happened."""


def finish_all(sinks: Iterable[Sink], run: RunResult) -> None:
    """Let every sink finish, also after one that could not; ``run`` holds the errors and a warning for each.

    Args:
        sinks: in the order in which they depend on each other's results.
        run: is filled in.
    """
    for sink in sinks:
        try:
            sink.finish(run)
        except Exception as error:
            run.unfinished.append(error)
            run.metrics["warnings"].append(
                f"{type(sink).__name__} could not finish ({type(error).__name__}: {error}); what the others "
                "found is complete."
            )
    # not before: sinks that finish must be able to tell that the run itself came to its end
    if run.interruption is None and run.unfinished:
        run.interruption = run.unfinished[0]
