"""Accept loops that other loops confirm: two loops and the odometry between their ends make a closed circle.

The test is pairwise consistency (Mangelson, Dominic, Eustice & Vasudevan, "Pairwise consistent measurement
set maximization for robust multi-robot map merging", ICRA 2018), in the order in which the loops are found.
Only loops near each other are compared: their circle contains little odometry, so drift hardly affects it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.proposals import possible_error
from lio_jax.loops.verification import Verdict

_SUPPORT = 2
"""Least number of near loops that have to confirm a loop."""


class Consensus:
    """Verified loops: those in the graph, and those that wait for confirmation."""

    def __init__(self, limits: Mapping[str, Any]) -> None:
        """Begin without loops.

        Args:
            limits: ``params.loop`` as plain numbers.
        """
        self._limits = limits
        self.entered: list[Verdict] = []
        self.waiting: list[Verdict] = []
        self._doubtful: list[int] = []

    def doubt(self, source: int) -> None:
        """Note a keyframe that looks like several places, or that was aligned with several.

        Each such keyframe near a loop counts as a loop that contradicts it.

        Args:
            source: index of the keyframe.
        """
        self._doubtful.append(source)

    def with_loop(
        self, loop: Verdict, keyframes: Sequence[Keyframe], run: NDArray[np.float64]
    ) -> list[Verdict]:
        """Take a verified loop, and return the loops that enter the graph now, possibly this one among them.

        A loop enters when at least two near loops agree with it, and more agree than contradict it. A loop
        from a file needs no confirmation if none contradicts it.

        Args:
            loop: a loop that :func:`~lio_jax.loops.verification.verify` accepted.
            keyframes: all so far.
            run: (k,) length of the odometry's path from the first keyframe to each one, m.
        """
        self.waiting.append(loop)
        entering = [waiting for waiting in self.waiting if self._confirmed(waiting, keyframes, run)]
        self.waiting = [waiting for waiting in self.waiting if waiting not in entering]
        self.entered += entering
        return entering

    def _confirmed(self, loop: Verdict, keyframes: Sequence[Keyframe], run: NDArray[np.float64]) -> bool:
        agree = 0
        near = np.abs(run[self._doubtful] - run[loop.proposal.source]) <= self._limits["support_reach"]
        contradict = int(np.sum(near))
        for other in (*self.entered, *self.waiting):
            legs = _legs(loop, other, run)
            if other is loop or max(legs) > self._limits["support_reach"]:
                continue
            if consistent(loop, other, keyframes, run, self._limits):
                agree += 1
            else:
                contradict += 1
        needed = 0 if loop.proposal.origin == "external" else _SUPPORT
        return agree >= max(needed, contradict + 1) or (needed == 0 and contradict == 0)


def consistent(
    a: Verdict,
    b: Verdict,
    keyframes: Sequence[Keyframe],
    run: NDArray[np.float64],
    limits: Mapping[str, Any],
) -> bool:
    """Return whether two loops and the odometry between their ends make a circle that closes.

    Args:
        a: one loop.
        b: the other loop.
        keyframes: all so far.
        run: (k,) length of the odometry's path from the first keyframe to each one, m.
        limits: ``params.loop`` as plain numbers.
    """
    odometry = [
        np.linalg.inv(keyframes[first].T_odom_imu) @ keyframes[second].T_odom_imu
        for first, second in (
            (a.proposal.target, b.proposal.target),
            (b.proposal.source, a.proposal.source),
        )
    ]
    around = np.linalg.inv(a.T_target_source) @ odometry[0] @ b.T_target_source @ odometry[1]
    error = possible_error(sum(_legs(a, b, run)), limits)
    turn = np.arccos(np.clip((np.trace(around[:3, :3]) - 1) / 2, -1, 1))
    return bool(np.linalg.norm(around[:3, 3]) <= error.position and turn <= error.heading)


def _legs(a: Verdict, b: Verdict, run: NDArray[np.float64]) -> tuple[float, float]:
    """Return the length of the odometry between the sources and between the targets of two loops, m."""
    return (
        float(abs(run[a.proposal.source] - run[b.proposal.source])),
        float(abs(run[a.proposal.target] - run[b.proposal.target])),
    )
