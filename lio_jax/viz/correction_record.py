"""Read back what a run's back end left in its folder."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.trajectory import Trajectory, read_tum
from lio_jax.run.keyframe_store import read_keyframes


@dataclass(frozen=True, eq=False)
class CorrectionRecord:
    """The corrected trajectory, and the loops between keyframes."""

    trajectory: Trajectory
    """T_world_imu at the scans' ends."""
    keyframes: NDArray[np.float64]
    """(k, 3) m, positions in world."""
    loops: list[dict[str, Any]]
    """As in loops.json."""

    def strips(self, closed: bool) -> NDArray[np.float64]:
        """Return (n, 2, 3) m, the ends of the loops that are closed, or of those that were refused.

        Of the latter a keyframe's first alone: it may have been compared with many others.
        """
        chosen: dict[Any, tuple[int, int]] = {}
        for number, loop in enumerate(self.loops):
            trusted = loop["weight"] is not None and loop["weight"] > 0.5
            if trusted == closed:
                chosen.setdefault(number if closed else loop["source"], (loop["source"], loop["target"]))
        ends = np.array(list(chosen.values()), np.int64).reshape(-1, 2)
        return self.keyframes[ends]


def read_correction(folder: Path) -> CorrectionRecord | None:
    """Read what the back end left; None in a run without one.

    Raises:
        LioJaxError: a file is damaged.
    """
    if not (folder / "odometry.tum").is_file():
        return None
    path = folder / "loops.json"
    try:
        loops = json.loads(path.read_text())["loops"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise LioJaxError(f"{path}: cannot be read ({error}); run again.") from None
    keyframes = read_keyframes(folder).T_world_imu[:, :3, 3]
    return CorrectionRecord(read_tum(folder / "trajectory.tum"), keyframes, loops)
