"""Close loops: propose them, verify them, and accept those that other loops confirm."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.params import BackEndSettings
from lio_jax.loops.place_descriptor import DescribedPlaces
from lio_jax.loops.proposals import (
    AT_LEAST,
    Pair,
    Proposal,
    described_proposals,
    external_proposal,
    is_old,
    keyframe_at,
    metres_from,
    metres_of,
    nearest_proposal,
    possible_error,
    read_pairs,
)
from lio_jax.loops.verification import Verdict, verify

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


_AMBIGUOUS = "another place fits as well"
_SAME = "another comparison of this keyframe says the same with more points"
_UNCONFIRMED = "no other loop nearby confirms it"


class LoopCloser:
    """The state of loop closing.

    Call :meth:`take` for each keyframe, or its parts :meth:`proposals_for`, ``verify`` and :meth:`settle`.
    """

    def __init__(self, settings: BackEndSettings) -> None:
        """Begin without keyframes.

        Args:
            settings: ``config.loops`` and ``params.loop``.

        Raises:
            LioJaxError: the file of pairs cannot be read, or a line of it is invalid.
        """
        sizes, limits = settings.run.loops, settings.values["loop"]
        self._settings, self._limits = settings, limits
        self._places = DescribedPlaces(sizes.rings, sizes.sectors, limits["descriptor_range"])
        self._consensus = Consensus(limits)
        self._pairs = read_pairs(Path(sizes.pairs)) if sizes.pairs else []
        self._run: list[float] = []
        """Length of the odometry's path from the first keyframe to each one, m. An outage counts as the way
        after which drift is as large as the outage's error."""
        self._refused: list[Verdict] = []
        self._without_keyframes: list[Pair] = []

    @property
    def closed(self) -> list[Verdict]:
        """Return the loops that are in the graph, in the order in which they entered."""
        return list(self._consensus.entered)

    def take(self, keyframes: Sequence[Keyframe], poses: NDArray[np.float64]) -> list[Verdict]:
        """Take the newest keyframe, and return the loops that enter the graph now.

        Args:
            keyframes: all so far; each call brings one more.
            poses: (k, 4, 4) their T_world_imu, corrected so far, m.
        """
        proposals = self.proposals_for(keyframes, poses)
        verdicts = [verify(proposal, keyframes, poses, self._settings) for proposal in proposals]
        return self.settle(verdicts, keyframes)

    def proposals_for(self, keyframes: Sequence[Keyframe], poses: NDArray[np.float64]) -> list[Proposal]:
        """Return the proposed loops of the newest keyframe. Call it once for each keyframe.

        Args:
            keyframes: all so far; each call brings one more.
            poses: (k, 4, 4) their T_world_imu, corrected so far, m.
        """
        self._places.add(keyframes[-1])
        step = keyframes[-1].T_odom_imu[:3, 3] - keyframes[-2 if len(keyframes) > 1 else -1].T_odom_imu[:3, 3]
        metres = float(np.linalg.norm(step)) + metres_of(keyframes[-1], self._limits)
        self._run.append(self._run[-1] + metres if self._run else 0.0)
        run = np.array(self._run)
        ends = held_by(poses, self._consensus.entered)
        ways = metres_from(len(keyframes) - 1, run, ends)
        old = is_old(keyframes, len(keyframes) - 1, self._limits["time_gap"])
        proposals = nearest_proposal(poses, old, ways, self._limits)
        proposals += described_proposals(self._places, poses, old, ways, self._limits)
        while self._pairs and self._pairs[0].later_ns <= keyframes[-1].stamp_ns:
            proposals += self._from_outside(self._pairs.pop(0), keyframes, poses, run, ends)
        return proposals

    def settle(self, verdicts: Sequence[Verdict], keyframes: Sequence[Keyframe]) -> list[Verdict]:
        """Take the verdicts on the newest proposals, and return the loops that enter the graph now.

        Args:
            verdicts: one for each proposal.
            keyframes: all so far.
        """
        run = np.array(self._run)
        self._refused += [verdict for verdict in verdicts if not verdict.accepted]
        accepted = [verdict for verdict in verdicts if verdict.accepted]
        for verdict in verdicts:
            if verdict.proposal.twin is not None:
                self._consensus.doubt(verdict.proposal.source)
        entering = []
        for verdict in accepted:
            if verdict.proposal.origin == "external":
                entering += self._consensus.with_loop(verdict, keyframes, run)
        own = [verdict for verdict in accepted if verdict.proposal.origin != "external"]
        own.sort(key=lambda verdict: -verdict.overlap)
        if all(consistent(own[0], other, keyframes, run, self._limits) for other in own[1:]):
            for verdict in own[:1]:
                entering += self._consensus.with_loop(verdict, keyframes, run)
            self._refused += [replace(verdict, accepted=False, reason=_SAME) for verdict in own[1:]]
        else:
            self._refused += [replace(verdict, accepted=False, reason=_AMBIGUOUS) for verdict in own]
            self._consensus.doubt(own[0].proposal.source)
        return entering

    def _from_outside(
        self,
        pair: Pair,
        keyframes: Sequence[Keyframe],
        poses: NDArray[np.float64],
        run: NDArray[np.float64],
        ends: Sequence[tuple[int, int]],
    ) -> list[Proposal]:
        source, target = (keyframe_at(keyframes, stamp) for stamp in (pair.later_ns, pair.earlier_ns))
        if source is None or target is None or source == target:
            self._without_keyframes.append(pair)
            return []
        metres = float(metres_from(source, run, ends)[target])
        return [external_proposal(source, target, pair.T_earlier_later, poses, metres, self._limits)]

    def outcomes(self) -> list[Verdict]:
        """Return the verdicts on all proposals so far, ordered by the newer keyframe."""
        waiting = [replace(loop, accepted=False, reason=_UNCONFIRMED) for loop in self._consensus.waiting]
        every = [*self._consensus.entered, *waiting, *self._refused]
        return sorted(every, key=lambda verdict: verdict.proposal.source)

    def untried(self) -> list[Pair]:
        """Return the pairs of the file that belong to no two keyframes so far."""
        return [*self._without_keyframes, *self._pairs]


def held_by(poses: NDArray[np.float64], loops: Sequence[Verdict]) -> list[tuple[int, int]]:
    """Return the two keyframes of each loop that agrees with the poses.

    A loop does not agree if no solve has used it yet, or if the graph rejected it.

    Args:
        poses: (k, 4, 4) T_world_imu, m.
        loops: loops that entered the graph.

    Returns:
        The indices of the newer and the older keyframe of each such loop.
    """
    if not loops:
        return []
    ends = np.array([(loop.proposal.source, loop.proposal.target) for loop in loops])
    measured = np.array([loop.T_target_source for loop in loops])
    wrong = np.linalg.inv(poses[ends[:, 0]]) @ poses[ends[:, 1]] @ measured
    turned = np.arccos(np.clip((np.trace(wrong[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    moved = np.linalg.norm(wrong[:, :3, 3], axis=1)
    return [(int(a), int(b)) for a, b in ends[(moved < AT_LEAST.position) & (turned < AT_LEAST.heading)]]
