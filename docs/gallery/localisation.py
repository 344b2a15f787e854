"""Draw a second lap that begins in the map of the first one, at a place that is searched."""

import tempfile
from pathlib import Path

import jax
import numpy as np
from picture import BEFORE, ESTIMATE, canvas, in_run_frame, legend_above, options, save, seconds
from scipy.spatial import cKDTree

from lio_jax import (
    ImuModel,
    SimulatedSequence,
    Trajectory,
    recipe_settings,
    run_sequence,
    settings_for,
    with_overrides,
)

FIRST, START, SECOND = 1000, 1130, 250
"""Number of scans of the first lap, first scan of the second run, and number of its scans."""


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    drive = SimulatedSequence(
        "city", duration_s=(START + SECOND) / 10 + 1, seed=3, beams=16, columns=512, imu=ImuModel()
    )
    settings, _ = settings_for(drive, recipe_settings("default"))
    with tempfile.TemporaryDirectory() as folder:
        earlier, later = Path(folder) / "earlier", Path(folder) / "later"
        first = run_sequence(drive, settings, earlier, count=FIRST)
        known = with_overrides(settings, [f"config.known_map.path={earlier}", "config.known_map.search=true"])
        second = run_sequence(drive, known, later, START, SECOND, notify=print)
    mapped, driven = first.trajectory, second.trajectory
    # the truth in the world of the first run, at the stamps of both
    both = Trajectory(
        np.concatenate([mapped.stamp_ns, driven.stamp_ns]), np.concatenate([mapped.poses, driven.poses])
    )
    error = np.linalg.norm(both.positions - in_run_frame(drive.truth(), both).positions, axis=1)
    errors_then, errors_now = np.split(error, [len(mapped)])
    # the error of the map where the second run is
    _, nearest = cKDTree(mapped.positions).query(driven.positions)

    figure, (above, below) = canvas(6.4, rows=2, height_ratios=(3, 1))
    points = first.map_points[first.map_points[:, 2] > 1.0]
    above.plot(*points[::7, :2].T, ",", color="0.6", alpha=0.5)
    above.plot(*mapped.positions[:, :2].T, color=BEFORE, lw=1.5, label="first run")
    above.plot(*driven.positions[:, :2].T, color=ESTIMATE, lw=3, label="second run")
    above.plot(*driven.positions[0, :2], "o", color=ESTIMATE, ms=9, label="start found")
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    legend_above(above, 3)
    below.plot(seconds(driven), 100 * errors_then[nearest], color=BEFORE)
    below.plot(seconds(driven), 100 * errors_now, color=ESTIMATE)
    below.set(xlabel="time of the second run [s]", ylabel="error [cm]", ylim=(0, None))
    for name, some in (("second run", errors_now), ("map where it is", errors_then[nearest])):
        print(f"error of the {name} in the world of the first run: {np.sqrt(np.mean(some**2)):.3f} m (RMS)")
    save(figure, out)


if __name__ == "__main__":
    main()
