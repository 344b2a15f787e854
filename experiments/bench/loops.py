"""Found, missed and wrong loops on simulated drives whose odometry drifts more than usual.

    python experiments/bench/loops.py [--only NAME ...] [--spacing M] [--json]

A keyframe is a revisit if it is within 10 m of a keyframe that is more than 30 s older; it is recalled if a
loop from it enters the graph. A loop is false if its error exceeds 1 m or 0.05 rad. Times are those of all
work of the back end for a keyframe, including the solves of the graph.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

if TYPE_CHECKING:
    from lio_jax.loops.back_end import Correction
    from lio_jax.loops.closing import LoopCloser
    from lio_jax.loops.keyframe import Keyframe

_REVISIT, _TIME_GAP = 10.0, 30.0
_FALSE = (1.0, 0.05)
_LOOP = [(-1, -1), (3, -1), (3, 1), (1, 1), (1, 3), (-1, 3)]
"""Crossings of the blocks' grid at which the loop of 1.1 km turns."""

Drive = tuple["list[Keyframe]", np.ndarray]
"""Keyframes and their true poses."""


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="drives; all without it")
    parser.add_argument("--spacing", type=float, default=1.0, help="of the keyframes, m")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    print(
        f"{'drive':28}{'metres':>8}{'drift m':>8}{'ATE m':>7}{'after':>7}{'revisits':>9}"
        f"{'recall':>8}{'loops':>7}{'false':>6}{'worst m':>8}{'worst rad':>10}{'ms':>7}{'p95':>7}"
    )
    rows = []
    for name, make in _drives(options.spacing).items():
        if options.only and name not in options.only:
            continue
        row = measured(*make())
        rows.append({"drive": name} | row)
        print(
            f"{name:28}{row['metres']:8.0f}{row['drift_m']:8.1f}"
            f"{row['ate_before_m']:7.2f}{row['ate_after_m']:7.2f}{row['revisits']:9d}{row['recall']:8.3f}"
            f"{row['loops']:7d}{row['false']:6d}{row['worst_m']:8.2f}{row['worst_rad']:10.4f}"
            f"{row['median_ms']:7.0f}{row['p95_ms']:7.0f}"
        )
        for reason, count in row["refused"].items():
            print(f"{'':28}{count:6d} {reason}")
    if options.json:
        print(json.dumps({"spacing": options.spacing, "rows": rows}))


def measured(keyframes: "list[Keyframe]", truth: np.ndarray) -> dict[str, Any]:
    """Return the figures of the table for one drive."""
    closer, found, seconds = closed(keyframes)
    revisited = revisits(keyframes, truth)
    loops = closer.closed
    errors = np.array(
        [error_of(loop.T_target_source, truth, loop.proposal.source, loop.proposal.target) for loop in loops]
    ).reshape(-1, 2)
    recalled = {loop.proposal.source for loop in loops} & set(revisited.tolist())
    odometry = np.array([keyframe.T_odom_imu for keyframe in keyframes])
    ran = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    reasons: dict[str, int] = {}
    for verdict in closer.outcomes():
        if not verdict.accepted:
            kind = " ".join(word for word in verdict.reason.split() if not any(c.isdigit() for c in word))
            reasons[kind] = reasons.get(kind, 0) + 1
    return {
        "keyframes": len(keyframes),
        "metres": float(ran),
        "drift_m": float(np.linalg.norm(odometry[:, :3, 3] - truth[:, :3, 3], axis=1).max()),
        "ate_before_m": absolute_error(odometry, truth),
        "ate_after_m": absolute_error(found.T_world_imu, truth),
        "revisits": len(revisited),
        "recall": len(recalled) / max(len(revisited), 1),
        "loops": len(loops),
        "false": int(np.sum((errors[:, 0] > _FALSE[0]) | (errors[:, 1] > _FALSE[1]))),
        "worst_m": float(errors[:, 0].max(initial=0.0)),
        "worst_rad": float(errors[:, 1].max(initial=0.0)),
        "median_ms": float(np.median(seconds) * 1e3),
        "p95_ms": float(np.percentile(seconds, 95) * 1e3),
        "refused": reasons,
    }


def closed(keyframes: "list[Keyframe]") -> "tuple[LoopCloser, Correction, np.ndarray]":
    """Return the loops of a drive, what its poses became, and each keyframe's s."""
    from lio_jax.loops.back_end import BackEnd
    from lio_jax.loops.closing import LoopCloser
    from lio_jax.settings.settings import Settings

    settings = Settings()
    closer = LoopCloser(settings)
    back_end = BackEnd(settings, closer, None)
    seconds = []
    for keyframe in keyframes:
        begin = time.perf_counter()
        back_end.add(keyframe)
        seconds.append(time.perf_counter() - begin)
    back_end.settle()
    return closer, back_end.correction(), np.array(seconds)


def absolute_error(poses: np.ndarray, truth: np.ndarray) -> float:
    """Return the root mean square distance of positions after the best rigid alignment, m."""
    from lio_jax.evaluation.trajectory_error import align, position_errors

    return float(np.sqrt(np.mean(position_errors(align(poses, truth), poses, truth) ** 2)))


def revisits(keyframes: "list[Keyframe]", truth: np.ndarray) -> np.ndarray:
    """Return the keyframes that are near a much older one."""
    stamps = np.array([keyframe.stamp_ns for keyframe in keyframes])
    found = []
    for index, stamp in enumerate(stamps):
        apart = np.linalg.norm(truth[:index, :3, 3] - truth[index, :3, 3], axis=1)
        if np.any((apart < _REVISIT) & (stamp - stamps[:index] > _TIME_GAP * 1e9)):
            found.append(index)
    return np.array(found, np.int64)


def error_of(T_target_source: np.ndarray, truth: np.ndarray, source: int, target: int) -> tuple[float, float]:
    """Return the error of a relative pose, m and rad."""
    wrong = np.linalg.inv(np.linalg.inv(truth[target]) @ truth[source]) @ T_target_source
    angle = np.arccos(np.clip((np.trace(wrong[:3, :3]) - 1) / 2, -1, 1))
    return float(np.linalg.norm(wrong[:3, 3])), float(angle)


def _drives(spacing: float) -> dict[str, Callable[[], Drive]]:
    return {
        "city, again": lambda: town("city", 0, again=1.0, spacing=spacing),
        "city, other lane, opposite": lambda: town("city", 1, again=-1.0, spacing=spacing),
        "city, 3 m aside": lambda: town("city", 2, again=1.0, aside=3.0, spacing=spacing),
        "street, again": lambda: town("street", 0, again=1.0, spacing=spacing),
        "tunnel, there and back": lambda: tunnel(spacing),
        "blocks all alike": lambda: alike(spacing=spacing),
    }


def town(
    name: str,
    seed: int,
    again: float,
    aside: float = 0.0,
    loop: Any = None,
    spacing: float = 1.0,
    speed: float = 8.0,
) -> Drive:
    """Return a drive around a loop twice, in the right lane.

    Args:
        name: name of the world.
        seed: seed of the world.
        again: 1: the second lap has the same direction; -1: it has the opposite direction.
        aside: offset of the second lap to the left, m.
        loop: crossings of the grid of blocks at which the loop turns, counterclockwise; None: 1.1 km.
        spacing: distance between keyframes, m.
        speed: speed of the body, m/s.
    """
    from simulated_keyframes import drifted, keyframes_of, times_along

    from lio_jax.sim.sequence import build

    truth = lap_twice(name, seed, again, aside, loop, spacing)
    odometry = drifted(truth, scale=0.01, heading=1.2e-4, noise=0.02, seed=seed)
    world = build(name, seed).world
    return keyframes_of(world, truth, odometry, times_along(truth, speed), seed=seed), truth


def lap_twice(
    name: str, seed: int, again: float = 1.0, aside: float = 0.0, loop: Any = None, spacing: float = 1.0
) -> np.ndarray:
    """Return the true poses (k, 4, 4) of :func:`town`."""
    from simulated_keyframes import driven, rounded

    from lio_jax.sim.blocks import LANE, PITCH
    from lio_jax.sim.blocks import lap as lap_of
    from lio_jax.sim.sequence import build

    world = build(name, seed).world
    # the world's origin is the start of its own route
    path = rounded(np.array(loop or _LOOP) * PITCH - lap_of()[0], spacing=spacing)
    first = driven(world, path, -LANE)
    second = driven(world, path if again > 0 else path[::-1], aside - LANE)
    return np.concatenate([first, second])


def tunnel(spacing: float = 1.0) -> Drive:
    """Return a drive through a smooth tunnel, and back in the same lane."""
    from simulated_keyframes import drifted, driven, keyframes_of, times_along

    from lio_jax.sim.sequence import build

    world = build("tunnel", 0).world
    along = np.arange(0.0, 660.0, spacing)
    there = np.stack([along, np.zeros_like(along)], axis=1)
    truth = np.concatenate([driven(world, there, above=3.0), driven(world, there[::-1], above=3.0)])
    odometry = drifted(truth, scale=0.02, heading=0.0, noise=0.02)
    return keyframes_of(world, truth, odometry, times_along(truth)), truth


def alike(length: float = 700.0, spacing: float = 1.0) -> Drive:
    """Return a drive out along a street and back along the next one, in a town of equal blocks.

    No place is seen twice.
    """
    from simulated_keyframes import drifted, driven, keyframes_of, rounded, times_along

    pitch = 60.0
    world = town_of_equal_blocks(pitch, int(length / pitch) + 4, 4)
    around = rounded([(0, 0), (length, 0), (length, pitch), (0, pitch)], spacing=spacing)
    # up to the corner before the first street is reached again
    path = around[(around[:, 0] > 10) | (np.arange(len(around)) > 20)][: int((2 * length + 20) / spacing)]
    truth = driven(world, path, above=3.0)
    odometry = drifted(truth, scale=-0.02, heading=0.0, noise=0.02)
    return keyframes_of(world, truth, odometry, times_along(truth)), truth


def town_of_equal_blocks(pitch: float, columns: int, rows: int) -> Any:
    """Return a grid of streets with equal blocks of the given pitch, m."""
    from lio_jax.sim.assembly import assembled, draws, upright

    rng = np.random.default_rng(4)
    houses = 16
    place = rng.uniform(8.0, pitch - 8.0, (houses, 2))
    # along the four sides, so that they are visible from the streets
    place[np.arange(houses), np.arange(houses) % 2] = np.where(np.arange(houses) % 4 < 2, 9.0, pitch - 9.0)
    width, depth, height = draws(rng, houses, (1.0, 4.0), (1.0, 4.0), (2.0, 9.0))
    half = np.stack([width / 2, depth / 2, height / 2], axis=1)
    center = np.column_stack([place, height / 2])
    block = upright(center - half, center + half, 0.4)
    shifts = [
        (column * pitch, row * pitch) for column in range(-2, columns - 2) for row in range(-2, rows - 1)
    ]
    boxes = np.concatenate([block + np.array([x, y, 0, 0, 0, 0, 0, 0]) for x, y in shifts])
    return assembled([0.0, 0.0, 0.0], planes=[[0, 0, 0, 0, 0, 1, 0.2]], boxes=boxes)


if __name__ == "__main__":
    main()
