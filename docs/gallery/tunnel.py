"""Draw how far a filter is off in a smooth tunnel, how sure it says to be, and the direction that is open."""

import jax
import numpy as np
from picture import ESTIMATE, canvas, in_run_frame, options, run, save

from lio_jax import ImuModel, ScanResult, SimulatedSequence, Sink, lidar_pose


class Certainty(Sink):
    """Keeps the covariance of the position in the world, and the direction of which a scan says least."""

    def __init__(self) -> None:
        self.covariance: list[np.ndarray] = []
        self.weakest: list[np.ndarray] = []
        self.is_open: list[bool] = []

    def take(self, result: ScanResult) -> None:
        R, match = result.T_world_imu[:3, :3], result.output.registration
        self.covariance.append(R @ np.asarray(result.output.covariance)[3:6, 3:6] @ R.T)
        R_world_lidar = np.asarray(lidar_pose(result.nav).rotation().as_matrix())
        self.weakest.append(R_world_lidar @ np.linalg.eigh(np.asarray(match.information)[3:, 3:])[1][:, 0])
        self.is_open.append(bool(np.any(match.degenerate)))


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    drive = SimulatedSequence("tunnel", duration_s=55.0, beams=16, columns=512, imu=ImuModel())
    seen = Certainty()
    result = run(drive, sinks=[seen])
    truth = in_run_frame(drive.truth(), result.trajectory).positions
    error = result.trajectory.positions - truth
    sigma = np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2))
    x, is_open = truth[:, 0], np.array(seen.is_open)

    figure, (plan, *errors) = canvas(6.0, 3, sharex=True, height_ratios=(1, 1.3, 1.3))
    points = result.map_points[result.map_points[:, 2] < 3.0]
    plan.plot(*points[::5, :2].T, ",", color="0.6")
    plan.plot(*result.trajectory.positions[:, :2].T, color=ESTIMATE, lw=2)
    shown = [np.argmin(np.abs(x - place)) for place in range(120, 560, 80)]
    for number, place in enumerate(shown):
        ends = truth[place, :2] + 25 * np.outer([-1, 1], seen.weakest[place][:2])
        plan.annotate("", ends[1], ends[0], arrowprops={"arrowstyle": "<->", "color": "tab:red", "lw": 2})
        print(f"x {x[place]:.0f} m: open along {seen.weakest[place].round(2)}" if is_open[place] else number)
    plan.set(ylabel="y [m]", ylim=(-30, 30))
    for axis, axes, name in zip((0, 1), errors, ("along", "across"), strict=True):
        axes.fill_between(x, -3 * sigma[:, axis], 3 * sigma[:, axis], color=ESTIMATE, alpha=0.2, lw=0)
        axes.plot(x, error[:, axis], color=ESTIMATE, lw=2)
        axes.set(ylabel=f"error {name} [m]", ylim=(-6, 6))
    for axes in errors:
        axes.fill_between(
            x, 0, 1, where=is_open, transform=axes.get_xaxis_transform(), color="tab:orange", alpha=0.15, lw=0
        )
    errors[1].set(xlabel="x [m]")
    save(figure, out)


if __name__ == "__main__":
    main()
