"""Let loops into the graph that others confirm: each pair of loops makes a circle with odometry between them.

Pairwise consistency (Mangelson, Dominic, Eustice & Vasudevan, "Pairwise consistent measurement set
maximization for robust multi-robot map merging", ICRA 2018), decided as the loops come: only loops near each
other are compared, whose circle holds so little odometry that drift says next to nothing.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.proposals import possible_error
from lio_jax.loops.verification import Verdict

_SUPPORT = 2
"""Loops nearby that have to confirm one."""


class Consensus:
    """Verified loops: those in the graph, and those that wait for others."""

    def __init__(self, limits: Mapping[str, Any]) -> None:
        """Begin with none.

        Args:
            limits: ``params.loop`` as plain numbers.
        """
        self._limits = limits
        self.entered: list[Verdict] = []
        self.waiting: list[Verdict] = []
        self._doubtful: list[int] = []

    def doubt(self, source: int) -> None:
        """Note a keyframe that looks like several places, or was found to be in several: a loop in its
        neighbourhood has to be confirmed by more others than there are of them."""
        self._doubtful.append(source)

    def with_loop(
        self, loop: Verdict, keyframes: Sequence[Keyframe], run: NDArray[np.float64]
    ) -> list[Verdict]:
        """Take up a verified loop; return those that enter the graph now, it among them or not.

        A loop enters when at least two near it agree with it and fewer contradict it. One from outside needs
        no others, but none may contradict it.

        Args:
            loop: accepted by :func:`~lio_jax.loops.verification.verify`.
            keyframes: all so far.
            run: (k,) what the odometry has run up to each, m.
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
        b: the other.
        keyframes: all so far.
        run: (k,) what the odometry has run up to each, m.
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
    """Return the odometry between the sources and between the targets of two loops, m."""
    return (
        float(abs(run[a.proposal.source] - run[b.proposal.source])),
        float(abs(run[a.proposal.target] - run[b.proposal.target])),
    )
