"""Draw the map of a lap through a simulated city from above, coloured by height."""

import jax
import numpy as np
from picture import canvas, in_run_frame, legend_above, options, run, save
from scipy.stats import binned_statistic_2d

from lio_jax import ImuModel, SimulatedSequence

CELL = 0.4
"""Edge of a picture element, m."""


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    drive = SimulatedSequence("city", duration_s=102.0, seed=3, columns=512, imu=ImuModel())
    result = run(drive)
    x, y, z = result.map_points.T

    # the highest point of each cell hides those below it, as from above
    edges = [np.arange(axis.min() - 50, axis.max() + 50, CELL) for axis in result.trajectory.positions.T[:2]]
    height = binned_statistic_2d(x, y, z, "max", edges).statistic.T

    figure, (axes,) = canvas(4.9)
    extent = (edges[0][0], edges[0][-1], edges[1][0], edges[1][-1])
    shown = axes.imshow(height, origin="lower", extent=extent, cmap="viridis", vmin=-4, vmax=12)
    true = in_run_frame(drive.truth(), result.trajectory).positions
    axes.plot(*true[:, :2].T, color="white", lw=4, label="truth")
    axes.plot(*result.trajectory.positions[:, :2].T, color="tab:red", lw=1.5, label="estimate")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", facecolor="0.1")
    axes.grid(False)
    figure.colorbar(shown, label="height [m]", shrink=0.7)
    legend_above(axes, 2)
    axes.get_legend().legend_handles[0].set_color("0.7")
    print(f"{len(z)} points of the map, {len(true)} scans")
    save(figure, out)


if __name__ == "__main__":
    main()
