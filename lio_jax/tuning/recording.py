"""A piece of a recording, kept in memory and ready to be replayed with any parameters."""

from collections.abc import Iterator

import jax.numpy as jnp
import jaxlie
import numpy as np

from lio_jax.core.types import state_dtype
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.localise import check_no_known_map
from lio_jax.run.run import check_start, imu_feed
from lio_jax.run.scan_inputs import ScanInput
from lio_jax.run.track import scan_inputs
from lio_jax.settings.settings import Settings
from lio_jax.tuning.objectives import TruePose


class Recording:
    """Padded scans, inertial samples and truth of scans ``start`` to ``start + count``."""

    def __init__(
        self,
        sequence: Sequence,
        settings: Settings,
        start: int = 0,
        count: int | None = None,
        truth: Trajectory | None = None,
        keep: bool = True,
    ) -> None:
        """Read the inertial samples and the truth.

        Args:
            sequence: the recording.
            settings: recipe and config, for the padded sizes.
            start: first scan.
            count: number of scans; None: to the end.
            truth: in place of the recording's own.
            keep: decode the scans once and keep them; False: anew each time, in constant memory.

        Raises:
            UsageError: the recording ends before ``start``, or the settings name a known map.
        """
        check_start(sequence, start)
        check_no_known_map(settings, "gradients and tuning")
        self.name, self.sequence = sequence.info.name, sequence
        samples, self.notes = imu_feed(sequence, settings)
        self._truth = truth if truth is not None else sequence.truth()
        self._read = lambda: scan_inputs(settings, sequence.scans(start, count), samples)
        self._kept = list(self._read()) if keep else None
        remaining = max(0, sequence.info.scan_count - start)
        self._count = len(self._kept) if self._kept else min(remaining, count or remaining)

    def __len__(self) -> int:
        return self._count

    def scan_inputs(self) -> Iterator[ScanInput]:
        """Yield the scans."""
        return iter(self._kept) if self._kept is not None else self._read()

    def truth_at(self, end_ns: int) -> TruePose:
        """Return the true pose at a scan's end."""
        found = None if self._truth is None else self._truth.at(np.array([end_ns]))
        if found is None or not len(found):
            return TruePose(jaxlie.SE3.identity(), jnp.array(False))
        wxyz = found.quaternions[0][[3, 0, 1, 2]]
        pose = np.concatenate([wxyz, found.positions[0]]).astype(state_dtype())
        return TruePose(jaxlie.SE3(jnp.asarray(pose)), jnp.array(True))
