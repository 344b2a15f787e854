"""Draw the pictures of docs/symptoms.md: each fault is put into a simulated drive on purpose.

``python docs/figures/symptoms.py`` writes four PNG files beside itself and prints the errors.
"""

import tempfile
from pathlib import Path

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from lio_jax import (
    ImuModel,
    RunResult,
    Settings,
    SimulatedSequence,
    evaluate,
    run_sequence,
    settings_for,
    with_overrides,
)

HERE = Path(__file__).parent
SMALL = {"beams": 16, "columns": 512}
NO_IMU = "config.imu.use=false"


def run(drive: SimulatedSequence, *overrides: str) -> RunResult:
    """Run the default recipe on a drive."""
    settings, _ = settings_for(drive, with_overrides(Settings(), list(overrides)))
    with tempfile.TemporaryDirectory() as folder:
        result = run_sequence(drive, settings, Path(folder))
    error = evaluate(result.trajectory, drive.truth()).ate
    state = result.metrics["verdict"]["state"]
    print(f"{' '.join(overrides) or 'as recorded':60s} ATE {error.rmse:.3f} m, {state}", flush=True)
    return result


def in_run_frame(drive: SimulatedSequence, result: RunResult) -> np.ndarray:
    """Return the true positions at the run's stamps, in the run's world, (n, 3) m."""
    truth = drive.truth().at(result.trajectory.stamp_ns)
    moved = result.trajectory.poses[0] @ np.linalg.inv(truth.poses[0]) @ truth.poses
    return moved[:, :3, 3]


def way(positions: np.ndarray) -> np.ndarray:
    """Return the distance travelled at each position, (n,) m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def save(figure: plt.Figure, name: str) -> None:
    figure.savefig(HERE / f"{name}.png", dpi=110)
    plt.close(figure)


def double_walls(drive: SimulatedSequence, good: RunResult) -> None:
    bad = run(drive, "params.extrinsics.time_offset=0.1")
    middle = good.trajectory.positions.mean(axis=0)
    figure, panels = plt.subplots(1, 2, figsize=(9, 4.4), sharex=True, sharey=True, layout="constrained")
    for axes, result, title in zip(panels, (good, bad), ("right clock", "clock 0.1 s off"), strict=True):
        points = result.map_points
        upright = points[(points[:, 2] > 0.0) & (points[:, 2] < 3.0)]
        axes.plot(*upright[:, :2].T, ".", markersize=1.5, color="0.25")
        axes.plot(*result.trajectory.positions[:, :2].T, color="tab:orange", linewidth=2, label="estimate")
        axes.plot(*in_run_frame(drive, result)[:, :2].T, "--", color="tab:blue", linewidth=1, label="truth")
        axes.set(title=title, xlabel="x [m]", aspect="equal")
        axes.set(xlim=(middle[0] - 25, middle[0] + 25), ylim=(middle[1] - 22, middle[1] + 22))
    panels[0].set_ylabel("y [m]")
    panels[0].legend(loc="lower left")
    save(figure, "double_walls")


def drift_in_z() -> None:
    drive = SimulatedSequence("street", duration_s=8.0, moving_start=True, **SMALL)
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    for degrees, colour in ((0.0, "tab:green"), (0.5, "tab:orange"), (-0.5, "tab:red")):
        result = run(drive, f"params.lidar.elevation_offset={np.radians(degrees):.5f}")
        true = in_run_frame(drive, result)
        error = result.trajectory.positions[:, 2] - true[:, 2]
        axes.plot(way(true), error, color=colour, label=f"elevations off by {degrees:+g} deg")
    axes.set(xlabel="way [m]", ylabel="error of z [m]")
    axes.legend()
    axes.grid(alpha=0.3)
    save(figure, "drift_in_z")


def lost_in_turns() -> None:
    drive = SimulatedSequence("office", duration_s=8.0, imu=ImuModel(), swing_rate=4.0, **SMALL)
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    runs = (("with inertial samples", (), "tab:green"), ("without", (NO_IMU,), "tab:red"))
    for label, overrides, colour in runs:
        result = run(drive, *overrides)
        seconds = (result.trajectory.stamp_ns - result.trajectory.stamp_ns[0]) * 1e-9
        error = np.linalg.norm(result.trajectory.positions - in_run_frame(drive, result), axis=1)
        axes.plot(seconds, error, color=colour, label=label)
    axes.set(xlabel="time [s]", ylabel="error of the position [m]", yscale="log", ylim=(1e-3, None))
    axes.legend()
    axes.grid(alpha=0.3)
    save(figure, "lost_in_turns")


def jumps() -> None:
    drive = SimulatedSequence("tunnel", duration_s=8.0, imu=ImuModel(), **SMALL)
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    runs = (("with inertial samples", (), "tab:green"), ("without", (NO_IMU,), "tab:red"))
    for label, overrides, colour in runs:
        result = run(drive, *overrides)
        true = way(in_run_frame(drive, result))
        axes.plot(true, way(result.trajectory.positions), color=colour, label=label)
    axes.plot(true, true, "--", color="0.4", label="truth")
    axes.set(xlabel="true way along the tunnel [m]", ylabel="estimated way [m]")
    axes.legend()
    axes.grid(alpha=0.3)
    save(figure, "jumps")


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    drive = SimulatedSequence("city", duration_s=8.0, imu=ImuModel(), standstill_s=0.5, **SMALL)
    double_walls(drive, run(drive))
    drift_in_z()
    lost_in_turns()
    jumps()


if __name__ == "__main__":
    main()
