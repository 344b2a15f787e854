"""Draw the error along a tunnel, where there are no GPS fixes, before and after the correction."""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from picture import BEFORE, ESTIMATE, canvas, in_run_frame, legend_above, options, run, save

from lio_jax import GpsModel, ImuModel, SimulatedSequence

ENTRY, EXIT = 60.0, 620.0
"""Portals of the tunnel along x, m from the start of the route."""


class Tunnel(SimulatedSequence):
    """A drive through a tunnel in which the receiver sees no satellites."""

    def gps(self):
        fixes = super().gps()
        x = self.truth().at(fixes.stamp_ns).positions[:, 0]
        seen = (x < ENTRY) | (x > EXIT)
        arrays = {name: getattr(fixes, name)[seen] for name in ("stamp_ns", "position", "covariance")}
        return replace(fixes, **arrays)


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    drive = Tunnel("tunnel", duration_s=62.0, beams=16, columns=512, imu=ImuModel(), gps=GpsModel())
    with tempfile.TemporaryDirectory() as folder:
        result = run(drive, "config.backend.gps=true", folder=Path(folder))
        earth = json.loads((Path(folder) / "georeference.json").read_text())
    fixes, truth = drive.gps(), drive.truth()
    true = truth.at(result.trajectory.stamp_ns).positions
    # the tunnel runs along x: to the east, and ahead of the vehicle when it starts
    odometry = result.odometry.positions - in_run_frame(truth, result.odometry).positions
    corrected = (np.array(earth["T_enu_world"]) @ result.trajectory.poses)[:, :3, 3] - true
    at_fixes = truth.at(fixes.stamp_ns).positions

    figure, (axes,) = canvas(3.8)
    axes.axvspan(ENTRY, EXIT, color="0.92")
    axes.text((ENTRY + EXIT) / 2, 0.9, "tunnel", transform=axes.get_xaxis_transform(), ha="center")
    axes.plot(at_fixes[:, 0], (fixes.position - at_fixes)[:, 0], ".", color="0.4", label="fixes")
    axes.plot(true[:, 0], odometry[:, 0], color=BEFORE, lw=2, label="odometry")
    axes.plot(true[:, 0], corrected[:, 0], color=ESTIMATE, lw=2, label="corrected")
    axes.set(xlabel="way [m]", ylabel="error along the tunnel [m]")
    legend_above(axes, 3)
    save(figure, out)


if __name__ == "__main__":
    main()
