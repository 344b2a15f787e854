"""Feed scans through a recipe's step, one by one, and bring each result back to the host."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.config import Config
from lio_jax.core.params import Params
from lio_jax.core.settings import Settings
from lio_jax.data.sequence import LidarScan
from lio_jax.recipes import recipe_named
from lio_jax.run.failures import Evidence, failure_of, longest_gap
from lio_jax.run.feed import bucket_for, padded
from lio_jax.run.imu_feed import ImuFeed


@dataclass(frozen=True)
class Tracked:
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


class CompiledStep:
    """A recipe's step, compiled once per scan size, with the compile time kept apart from the run time."""

    def __init__(self, settings: Settings) -> None:
        self._recipe = recipe = recipe_named(settings.recipe)
        self.config: Config = settings.config
        self.params: Params = settings.params()
        self.compile_s = 0.0
        self._init = jax.jit(partial(recipe.init, self.config))
        self._step = jax.jit(partial(recipe.step, self.config), donate_argnums=1)
        self._programs: dict[Any, Any] = {}

    def initial_state(self, imu: Any) -> Any:
        """Return the recipe's state before the first scan; ``imu``: samples up to its end, or None."""
        return self._run("init", self._init, self.params, imu)

    def restarted(self, state: Any, imu: Any) -> Any:
        """Return the state before the first scan, with the velocity that ``state`` found."""
        # no program of its own, which takes as long to compile as the first
        return self._recipe.moving_as(self.initial_state(imu), state)

    def __call__(self, state: Any, scan: Any, imu: Any) -> tuple[Any, Any]:
        """Run one step; ``state`` is consumed."""
        return self._run("step", self._step, self.params, state, scan, imu)

    def _run(self, name: str, function: Any, *arguments: Any) -> Any:
        key = (name, *(leaf.shape for leaf in jax.tree.leaves(arguments)))
        if key not in self._programs:
            start = time.perf_counter()
            self._programs[key] = function.lower(*arguments).compile()
            self.compile_s += time.perf_counter() - start
        return self._programs[key](*arguments)


def track(
    settings: Settings,
    scans: Iterable[LidarScan],
    imu: ImuFeed | None = None,
    step: CompiledStep | None = None,
) -> Iterator[Tracked]:
    """Yield the result of each scan in turn.

    Args:
        settings: recipe, config and params.
        scans: in time order.
        imu: inertial samples; None where there are none or the recipe is to do without.
        step: a compiled step of the same settings, to reuse its programs over several recordings.
    """
    step = step or CompiledStep(settings)
    state: Any = None
    before: Any = None
    last_end_ns, last_count, size = None, 0, 0
    opening: list[Any] = []
    last_evidence: Evidence | None = None
    for index, scan in enumerate(scans):
        start = time.perf_counter()
        count = len(scan.points)
        # an empty or torn scan among whole ones is not worth compiling a program of its own size
        if count >= _STRAGGLER * last_count:
            size = bucket_for(count, settings.config.lidar)
        arrays = padded(scan, last_end_ns, settings.config.lidar, size)
        samples = imu.batch(scan, last_end_ns) if imu else None
        padded_at = time.perf_counter()
        compiled_s = step.compile_s
        if state is None or (count and not opening):
            before = imu.before(scan) if imu else None
            state = step.initial_state(before)
        if len(opening) == 1 and count:
            state = _reopened(step, state, before, opening[0], (arrays, samples))
        if len(opening) < 2 and count:
            opening.append((arrays, samples))
        state, output = step(state, arrays, samples)
        nav, result = jax.tree.map(np.array, (state.nav, output.registration))
        lost, nis = bool(output.lost), float(output.nis)
        done = time.perf_counter()
        evidence = Evidence(
            points=count,
            nav=nav,
            registration=result,
            lost=lost,
            nis=nis,
            since_last_s=float(arrays.interval),
            imu_gap_s=_imu_gap(samples, arrays, nav) if samples else None,
        )
        failure = failure_of(evidence, last_evidence, settings)
        last_end_ns, last_count, last_evidence = scan.end_ns, count, evidence
        pad_ms = (padded_at - start) * 1e3
        step_ms = (done - padded_at - (step.compile_s - compiled_s)) * 1e3
        yield Tracked(
            index=index,
            stamp_ns=scan.end_ns,
            T_world_imu=pose_matrix(nav.T_world_imu.wxyz_xyz),
            nav=nav,
            output=output,
            scan_points=count,
            stage_ms={"pad": pad_ms, "step": step_ms, "total": pad_ms + step_ms},
            failure=failure,
        )


def _reopened(step: CompiledStep, state: Any, before: Any, first: Any, second: Any) -> Any:
    """Return the state after the first scan, compensated with the velocity that the second one shows.

    Only the second scan tells how fast a vehicle is moving from the start; until then the map holds the first
    scan distorted.
    """
    if first[0].duration == 0 or first[0].points.shape != second[0].points.shape:
        return state
    trial, _ = step(state, *second)
    return step(step.restarted(trial, before), *first)[0]


_STRAGGLER = 0.25
"""A scan with less than this share of the points of the scan before keeps that one's padded size."""


def pose_matrix(wxyz_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the 4x4 matrix of a quaternion (w first) and a translation."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(wxyz_xyz[[1, 2, 3, 0]]).as_matrix()
    pose[:3, 3] = wxyz_xyz[4:]
    return pose


def _imu_gap(samples: Any, scan: Any, nav: Any) -> float:
    """Return the longest time without an inertial sample since the last scan's end, s."""
    end = float(scan.duration) + float(nav.time_offset)
    return longest_gap(samples, end - float(scan.interval or scan.duration), end)
