"""Draw the pictures of docs/symptoms.md: each fault is put into a simulated drive on purpose.

``python docs/figures/symptoms.py`` writes five PNG files beside itself and prints the errors.
"""

import sys
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
    figure.savefig(HERE / f"{name}.png", dpi=110, bbox_inches="tight")
    plt.close(figure)


def double_walls() -> None:
    drive = SimulatedSequence("office", duration_s=6.0, imu=ImuModel(), swing_rate=4.0, **SMALL)
    figure, panels = plt.subplots(1, 2, figsize=(9, 4.6), sharex=True, sharey=True, layout="constrained")
    for axes, seconds in zip(panels, (0.0, 0.1), strict=True):
        result = run(drive, f"params.extrinsics.time_offset={seconds}", "params.map.point_spacing=0.1")
        points = result.map_points
        upright = points[(points[:, 2] > -0.8) & (points[:, 2] < 0.8)]
        axes.plot(*upright[:, :2].T, ".", markersize=1.2, color="0.25")
        axes.plot(*in_run_frame(drive, result)[:, :2].T, "--", color="tab:blue", linewidth=2, label="truth")
        axes.plot(*result.trajectory.positions[:, :2].T, color="tab:orange", linewidth=2, label="estimate")
        axes.set(
            title="right clock" if not seconds else f"clock {seconds} s off", xlabel="x [m]", aspect="equal"
        )
        axes.set(xlim=(-9, 9), ylim=(-9, 9))
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
    drive = SimulatedSequence("office", duration_s=6.0, imu=ImuModel(), swing_rate=8.0, **SMALL)
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    runs = (("with inertial samples", (), "tab:green"), ("without", (NO_IMU,), "tab:red"))
    for label, overrides, colour in runs:
        result = run(drive, *overrides)
        seconds = (result.trajectory.stamp_ns - result.trajectory.stamp_ns[0]) * 1e-9
        error = np.linalg.norm(result.trajectory.positions - in_run_frame(drive, result), axis=1)
        axes.plot(seconds, error, color=colour, label=label)
    axes.set(xlabel="time [s]", ylabel="error of the position [m]", yscale="log", ylim=(1e-3, 10))
    axes.legend()
    axes.grid(alpha=0.3)
    save(figure, "lost_in_turns")


def tunnel(*, moving_start: bool) -> SimulatedSequence:
    return SimulatedSequence(
        "tunnel", duration_s=12.0, imu=ImuModel(), moving_start=moving_start, beams=8, columns=512
    )


def slow_start() -> None:
    drive = tunnel(moving_start=True)
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    true = drive.truth()
    speed = np.linalg.norm(true.positions[-1] - true.positions[0]) / (
        1e-9 * (true.stamp_ns[-1] - true.stamp_ns[0])
    )
    given = (f"params.initial.velocity=[{speed:.1f},0,0]", "params.initial.velocity_sigma=0.1")
    runs = (("first velocity given", given, "tab:green"), ("as recorded", (), "tab:red"))
    draw_way(axes, drive, runs)
    save(figure, "slow_start")


def jumps() -> None:
    figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
    runs = (("with inertial samples", (), "tab:green"), ("without", (NO_IMU,), "tab:red"))
    draw_way(axes, tunnel(moving_start=False), runs)
    save(figure, "jumps")


def draw_way(
    axes: plt.Axes, drive: SimulatedSequence, runs: tuple[tuple[str, tuple[str, ...], str], ...]
) -> None:
    """Draw the estimated way of each run, given by its label, overrides and colour, over the true way."""
    for label, overrides, colour in runs:
        result = run(drive, *overrides)
        true = way(in_run_frame(drive, result))
        axes.plot(true, way(result.trajectory.positions), color=colour, label=label)
    axes.plot(true, true, "--", color="0.4", label="truth")
    axes.set(xlabel="true way along the tunnel [m]", ylabel="estimated way [m]")
    axes.legend()
    axes.grid(alpha=0.3)


DRAWN = (double_walls, drift_in_z, lost_in_turns, slow_start, jumps)


def main(names: list[str]) -> None:
    """Draw the pictures that are named; without names, all of them."""
    jax.config.update("jax_enable_x64", True)
    for draw in DRAWN:
        if not names or draw.__name__ in names:
            draw()


if __name__ == "__main__":
    main(sys.argv[1:])
