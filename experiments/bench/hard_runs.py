"""A recipe's or a peer's run over some scans, with what the run says of itself."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from inertial_peers import Rig, RkoLio
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from systems import KissIcp, System

from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.run.run import imu_feed, settings_for
from lio_jax.run.set_up_check import Fault, SetUpCheck
from lio_jax.run.sinks import RunResult
from lio_jax.run.track import track
from lio_jax.run.verdict import Verdict
from lio_jax.settings.settings import recipe_settings, with_overrides

PEERS = "kiss-icp", "rko-lio"
"""Systems beside the recipes; their poses are those of the scan's end."""
_THREADS = 2


class Posed(NamedTuple):
    """A system's result for one scan."""

    stamp_ns: int
    T_world_imu: NDArray[np.float64]
    """(4, 4) m."""
    lost: bool = False
    failed: bool = False
    """Whether the run names a failure of this scan."""
    covariance: NDArray[np.float64] | None = None
    """(3, 3) covariance of the position along the body's axes, m^2; None where the system states none."""


@dataclass(frozen=True)
class Judged:
    """A run with what it says of itself; of a peer only the poses are known."""

    results: list[Posed]
    verdict: dict[str, Any]
    faults: list[Fault] = field(default_factory=list)
    sigma: float | None = None
    """Standard deviation of the last position, m."""
    warnings: list[tuple[float, str]] = field(default_factory=list)
    """Each reason to doubt the run, after the time at which it was first known, s since the first scan."""


_LIDAR_ONLY = ":lidar"
"""Ends a recipe's name where it is to do without inertial samples."""


def judged(sequence: Sequence, scans: Iterable[LidarScan], system: str, lidar_only: bool = False) -> Judged:
    """Return the run of a recipe, ``NAME`` or ``NAME:lidar``, or of a peer over some scans."""
    lidar_only, system = lidar_only or system.endswith(_LIDAR_ONLY), system.removesuffix(_LIDAR_ONLY)
    if system in PEERS:
        return Judged(peer_poses(sequence, scans, system), {"state": "-", "since_s": None})
    settings = recipe_settings(system)
    if lidar_only and system != "loam":
        settings = with_overrides(settings, ["config.imu.use=false"])
    settings, _ = settings_for(sequence, settings)
    imu, _ = imu_feed(sequence, settings)
    results, run, covariance = [], RunResult(), None
    check, judge = SetUpCheck(settings, imu.samples if imu else None), Verdict(settings)
    warnings: dict[str, float] = {}
    first_ns: int | None = None
    for result in track(settings, scans, imu):
        check.take(result)
        judge.take(result)
        first_ns = result.stamp_ns if first_ns is None else first_ns
        for reason in [*judge.verdict()["reasons"], *(fault.sentence for fault in check.faults.values())]:
            warnings.setdefault(reason, (result.stamp_ns - first_ns) * 1e-9)
        covariance = result.output.covariance
        position = None if covariance is None else np.asarray(covariance)[3:6, 3:6]
        lost, failed = bool(result.output.lost), bool(result.failure)
        results.append(Posed(result.stamp_ns, result.T_world_imu, lost, failed, position))
    check.finish(run)
    judge.finish(run)
    sigma = None if covariance is None else float(np.sqrt(np.trace(np.asarray(covariance)[3:6, 3:6])))
    in_turn = sorted((since, reason) for reason, since in warnings.items())
    return Judged(results, run.metrics["verdict"], list(check.faults.values()), sigma, in_turn)


def peer_poses(sequence: Sequence, scans: Iterable[LidarScan], name: str) -> list[Posed]:
    """Return a peer's poses over some scans."""
    T_imu_lidar = np.eye(4)
    if sequence.info.T_imu_lidar is not None:
        T_imu_lidar = np.array(sequence.info.T_imu_lidar)
        # RKO-LIO aborts on a rotation that is orthogonal to the digits of a text file
        T_imu_lidar[:3, :3] = Rotation.from_matrix(T_imu_lidar[:3, :3]).as_matrix()
    system: System | None = None
    poses: list[Posed] = []
    for scan in scans:
        if system is None:
            system = _peer(name, sequence, T_imu_lidar, scan)
        T_world_lidar = np.array(system.register(system.prepare(scan)))
        poses.append(Posed(scan.end_ns, T_world_lidar @ np.linalg.inv(T_imu_lidar)))
    return poses


def _peer(name: str, sequence: Sequence, T_imu_lidar: NDArray[np.float64], first: LidarScan) -> System:
    if name == "kiss-icp":
        return KissIcp(_THREADS)
    rig = Rig(
        T_imu_lidar,
        sequence.imu(),
        beams=int(first.ring.max()) + 1,
        columns=0,
        min_range=1.0,
        max_range=200.0,
        noise={},
        starts_at_rest=False,
    )
    return RkoLio(_THREADS, rig)


def relative(results: list[Posed], sequence: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Return estimated and true poses (n, 4, 4), each relative to the first."""
    stamps = np.array([one.stamp_ns for one in results])
    truth = sequence.truth()
    assert truth is not None
    true = truth.at(stamps)
    poses = np.array([one.T_world_imu for one in results])[np.isin(stamps, true.stamp_ns)]
    return np.linalg.inv(poses[0]) @ poses, np.linalg.inv(true.poses[0]) @ true.poses


def in_sigmas(
    results: list[Posed], estimated: NDArray[np.float64], true: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the errors of positions over the standard deviations that the system states along them, (n,).

    Args:
        results: n of them.
        estimated: (n, 4, 4) poses, relative to the first.
        true: the same of the truth.
    """
    ratios = np.zeros(len(results))
    for row, one in enumerate(results):
        error = estimated[row, :3, :3].T @ (estimated - true)[row, :3, 3]
        length = float(np.linalg.norm(error))
        if one.covariance is None or not np.isfinite(one.covariance).all():
            ratios[row] = np.nan
        elif length > 0:
            unit = error / length
            ratios[row] = length / np.sqrt(max(unit @ one.covariance @ unit, 1e-12))
    return ratios


def moves(poses: np.ndarray) -> np.ndarray:
    """Return the distances between consecutive poses, m."""
    distances: NDArray[np.float64] = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return distances
