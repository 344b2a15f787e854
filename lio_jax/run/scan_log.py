"""What a run keeps of every scan beside its state: how long it took and how well it matched."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.files import atomic_path
from lio_jax.run.track import Tracked


class ScanLog:
    """Numbers in the order of the scans."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = []

    def append(self, number: int, tracked: Tracked) -> None:
        """Keep the numbers of one scan; ``number`` is its place in the recording."""
        found = tracked.output.registration
        self._rows.append(
            {
                "scan": number,
                "points": tracked.scan_points,
                "matches": int(found.matches),
                "rmse": float(found.rmse),
                "iterations": int(found.iterations),
                "unobserved": int(np.sum(found.degenerate)),
                "lost": bool(tracked.output.lost),
                "failed": bool(tracked.failure),
            }
        )

    def columns(self) -> dict[str, NDArray]:
        """Return one quantity of all scans by name."""
        return {name: np.array([row[name] for row in self._rows]) for name in self._rows[0]}

    def write_npz(self, path: Path, stage_ms: Mapping[str, list[float]]) -> None:
        """Write every column, one row a scan.

        - ``scan`` number in the recording; ``points`` as recorded;
        - ``matches`` points that found their counterpart in the map; ``rmse`` of their distances, m;
        - ``iterations`` of the solve; ``unobserved`` directions of six;
        - ``lost``: the pose is the prediction; ``failed``: metrics.json says why;
        - ``NAME_ms`` of each stage; ``total_ms`` is what a scan took, ``decode_ms`` ran on another thread;
          NaN where a run was interrupted.
        """
        stages = {f"{name}_ms": self._one_each(times) for name, times in stage_ms.items()}
        with atomic_path(path) as aside:
            # numpy's stubs take the keywords for its own options
            arrays: dict[str, Any] = self.columns() | stages
            np.savez_compressed(aside, **arrays)

    def _one_each(self, times: list[float]) -> NDArray[np.float64]:
        one_each = np.full(len(self._rows), np.nan)
        known = times[: len(one_each)]
        one_each[: len(known)] = known
        return one_each
