"""Draw the estimated biases of an inertial sensor with the true ones and with two standard deviations."""

import tempfile
from pathlib import Path

import jax
import numpy as np
from picture import canvas, legend_above, options, run, save, seconds

from lio_jax import ImuModel, SimulatedSequence

GYRO, ACCEL = slice(9, 12), slice(12, 15)
"""Places of the two biases in the error state."""


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    drive = SimulatedSequence("city", duration_s=20.0, seed=2, beams=16, columns=512, imu=ImuModel())
    with tempfile.TemporaryDirectory() as folder:
        result = run(drive, folder=Path(folder))
        states = dict(np.load(Path(folder) / "states.npz"))
    time, sigma = (
        seconds(result.trajectory),
        np.sqrt(np.diagonal(states["state_covariance"], axis1=1, axis2=2)),
    )
    known = drive.truth_arrays()
    stamps = known["imu_stamp_ns"]
    nearest = np.searchsorted(stamps, states["stamps_ns"]).clip(max=len(stamps) - 1)

    figure, panels = canvas(5.6, 2, sharex=True)
    kinds = (
        ("gyro_bias", states["biases"][:, :3], sigma[:, GYRO], "gyroscope [mrad/s]", (-1, 4)),
        ("accel_bias", states["biases"][:, 3:], sigma[:, ACCEL], "accelerometer [mm/s²]", (-60, 60)),
    )
    for axes, (name, bias, deviation, label, limits) in zip(panels, kinds, strict=True):
        for axis, colour in enumerate(("tab:blue", "tab:orange", "tab:green")):
            value, band = 1e3 * bias[:, axis], 2e3 * deviation[:, axis]
            axes.fill_between(time, value - band, value + band, color=colour, alpha=0.15, lw=0)
            axes.plot(time, value, color=colour, lw=2, label="xyz"[axis])
            axes.plot(time, 1e3 * known[name][nearest, axis], "--", color=colour, lw=1.5)
        axes.set(ylabel=label, ylim=limits)
    panels[0].plot([], [], "--", color="0.4", label="truth")
    panels[0].fill_between([], [], color="0.8", label="2 sigma")
    legend_above(panels[0], 5)
    panels[1].set(xlabel="time [s]")
    save(figure, out)


if __name__ == "__main__":
    main()
