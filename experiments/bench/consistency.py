"""Are the errors of shipped settings as large as the recipe says, on simulated drives with known truth?

    python experiments/bench/consistency.py [--recipe default] [--worlds city street office stairs]
        [--sensors generic32 vlp16 os1_64] [--seeds 0 1] [--seconds 30] [--set path=value ...] [--json]

NEES and NIS are given per degree of freedom: 1 is right, above it the covariance is too small. The first two
seconds are left out. The last two columns are the trajectory's error after the best rigid alignment, and the
position's error at the end with its standard deviation, without an alignment. ``--set config.imu.use=false``
does without the inertial samples, and there is no NIS then.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

_SETTLED = 20
_MOMENT_NS = 10_000_000
_PARTS = {"rotation": slice(0, 3), "position": slice(3, 6), "pose": slice(0, 6), "velocity": slice(6, 9)}


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--worlds", nargs="+", default=["city", "street", "office", "stairs"])
    parser.add_argument("--sensors", nargs="+", default=["generic32", "vlp16", "os1_64"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--set", nargs="*", default=[], dest="overrides", metavar="PATH=VALUE")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    jax.config.update("jax_enable_x64", True)
    names = [f"NEES {name}" for name in _PARTS] + ["NIS mean", "NIS median", "ATE mm", "end mm", "sigma mm"]
    print(f"{'world':8}{'sensor':>12}{'seed':>5}" + "".join(f"{name:>15}" for name in names))
    rows = []
    for world in options.worlds:
        for sensor in options.sensors:
            for seed in options.seeds:
                figures = judged(options.recipe, options.overrides, world, sensor, seed, options.seconds)
                rows.append({"world": world, "sensor": sensor, "seed": seed, **figures})
                cells = "".join(f"{value:15.3g}" for value in figures.values())
                print(f"{world:8}{sensor:>12}{seed:5d}{cells}", flush=True)
    pose = np.array([row["nees_pose"] for row in rows])
    outside = float(np.mean((pose < 0.25) | (pose > 4)))
    print(f"pose: mean {pose.mean():.2f}, {100 * outside:.0f} % of the runs outside of 0.25 to 4")
    if options.json:
        print(json.dumps({"recipe": options.recipe, "mean": pose.mean(), "outside": outside, "rows": rows}))


def judged(
    recipe: str, overrides: list[str], world: str, sensor: str, seed: int, seconds: float
) -> dict[str, float]:
    """Return the figures of one simulated drive."""
    from lio_jax import ImuModel, SimulatedSequence

    sequence = SimulatedSequence(world, sensor, seconds, seed, imu=ImuModel())
    return measured(recipe, overrides, sequence).figures


class Measured(NamedTuple):
    """What a run shows beside the truth."""

    figures: dict[str, float]
    """NEES and NIS per degree of freedom, and errors in mm."""
    verdict: dict[str, Any]
    """The run's own judgement, as in metrics.json."""
    lost_scans: int


def measured(recipe: str, overrides: list[str], sequence: Any) -> Measured:
    """Run a recipe with shipped settings over a recording that holds the truth."""
    from lio_jax.evaluation.trajectory_error import align, nees, position_errors
    from lio_jax.run.run import imu_feed, settings_for
    from lio_jax.run.track import track
    from lio_jax.run.verdict import Verdict
    from lio_jax.settings.settings import recipe_settings, with_overrides

    settings, _ = settings_for(sequence, with_overrides(recipe_settings(recipe), overrides))
    motion, truth, verdict, lost_scans = sequence.truth(), _Truth(), Verdict(settings), 0
    errors, covariances, nis, poses, references = [], [], [], [], []
    for result in track(settings, sequence.scans(), imu_feed(sequence, settings)[0]):
        verdict.take(result)
        lost_scans += bool(result.output.lost)
        at = motion.at(result.stamp_ns + np.array([-_MOMENT_NS, 0, _MOMENT_NS]))
        if len(at) < 3:
            continue
        velocity = (at.positions[2] - at.positions[0]) / (2e-9 * _MOMENT_NS)
        errors.append(truth.error(result.nav, at.poses[1], velocity))
        covariances.append(np.asarray(result.output.covariance)[:9, :9])
        nis.append((float(result.output.nis), int(result.output.nis_dof)))
        poses.append(result.T_world_imu)
        references.append(at.poses[1])
    error, covariance = np.array(errors)[_SETTLED:], np.array(covariances)[_SETTLED:]
    estimate, reference = np.array(poses), np.array(references)
    off = position_errors(align(estimate, reference), estimate, reference)
    squared, freedom = np.array(nis)[_SETTLED:].T
    found = {
        f"nees_{name}": float(np.mean(nees(error[:, part], covariance[:, part, part])))
        / (part.stop - part.start)
        for name, part in _PARTS.items()
    }
    figures = found | {
        "nis_mean": float(squared.sum() / max(freedom.sum(), 1)),
        "nis_median": float(np.median(squared / np.maximum(freedom, 1))),
        "ate_mm": 1e3 * float(np.sqrt(np.mean(off**2))),
        "end_mm": 1e3 * float(np.linalg.norm(error[-1, 3:6])),
        "sigma_mm": 1e3 * float(np.sqrt(np.trace(covariance[-1, 3:6, 3:6]))),
    }
    return Measured(figures, verdict.verdict(), lost_scans)


class _Truth:
    """The true state in the world that the first estimated pose defines."""

    def __init__(self) -> None:
        self._anchor: np.ndarray | None = None

    def error(self, nav: Any, T_truth_imu: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the errors (9,) of rotation, position and velocity, in the tangent space at the estimate."""
        from lio_jax.core.error_state import local

        if self._anchor is None:
            self._anchor = np.asarray(nav.T_world_imu.as_matrix()) @ np.linalg.inv(T_truth_imu)
        known = replace(
            nav,
            T_world_imu=jaxlie.SE3.from_matrix(jnp.asarray(self._anchor @ T_truth_imu)),
            velocity=jnp.asarray(self._anchor[:3, :3] @ velocity),
        )
        return np.asarray(local(nav, known))[:9]


if __name__ == "__main__":
    main()
