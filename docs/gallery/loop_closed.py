"""Draw a lap through a simulated city before and after its loops were closed."""

import json
import tempfile
from pathlib import Path

import jax
import numpy as np
from picture import BEFORE, ESTIMATE, TRUTH, canvas, in_run_frame, legend_above, options, run, save

from lio_jax import SimulatedSequence, Trajectory


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    # without inertial samples, and with elevations that are half a degree off, so that the drift can be seen
    drive = SimulatedSequence("city", duration_s=112.0, seed=1, beams=16, columns=512)
    wrong = f"params.lidar.elevation_offset={np.radians(0.5):.5f}"
    with tempfile.TemporaryDirectory() as folder:
        result = run(drive, wrong, "config.backend.loops=true", folder=Path(folder))
        loops = json.loads((Path(folder) / "loops.json").read_text())["loops"]
    truth = in_run_frame(drive.truth(), result.trajectory)
    for name, trajectory in (("before", result.odometry), ("after", result.trajectory)):
        print(f"{name}: height error at the end {trajectory.positions[-1, 2] - truth.positions[-1, 2]:.2f} m")
    lines = (
        ("before the correction", result.odometry, BEFORE, "-"),
        ("loops closed", result.trajectory, ESTIMATE, "-"),
        ("truth", truth, TRUTH, ":"),
    )

    figure, (plan, profile) = canvas(5.6, 2, height_ratios=(2.2, 1))
    for label, trajectory, colour, style in lines:
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1))])
        plan.plot(*trajectory.positions[:, :2].T, style, color=colour, lw=2, label=label)
        profile.plot(way, trajectory.positions[:, 2], style, color=colour, lw=2)
    ends = [ends_of(loop, result.odometry) for loop in loops if loop["weight"]]
    for place, pair in enumerate(ends):
        plan.plot(*pair[:, :2].T, color="tab:green", lw=1, label=None if place else f"{len(ends)} loops")
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    profile.set(xlabel="way [m]", ylabel="height [m]")
    legend_above(plan, 3)
    save(figure, out)


def ends_of(loop: dict, trajectory: Trajectory) -> np.ndarray:
    """Return the positions that a loop joins, (2, 3) m."""
    stamps = np.array([round(1e9 * float(loop[end])) for end in ("target_s", "source_s")])
    return trajectory.at(stamps.clip(*trajectory.stamp_ns[[0, -1]])).positions


if __name__ == "__main__":
    main()
