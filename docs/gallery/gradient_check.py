"""Draw the derivative of the trajectory error as tangents over the errors of whole runs."""

import jax
import numpy as np
from picture import canvas, options, save

from lio_jax import (
    ImuModel,
    Loss,
    Recording,
    SimulatedSequence,
    free_parameters,
    objective_named,
    recipe_settings,
    settings_for,
    with_overrides,
)

# the true lever arm is (0.1, 0, 0.2) m
WRONG = ["params.extrinsics.translation=[0.06,0.02,0.22]"]
NAMES = ["extrinsics.translation", "imu.accel_noise"]
X, NOISE = 0, 3
"""Places of the two parameters that are drawn in the vector of all."""


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    drive = SimulatedSequence("street", duration_s=8.0, beams=16, columns=512, imu=ImuModel())
    settings, _ = settings_for(drive, with_overrides(recipe_settings("default"), WRONG))
    free = free_parameters(settings.params(), NAMES)
    loss = Loss(settings.recipe, settings.config, free, objective_named("ate").objective, through_map=True)
    recording, start = Recording(drive, settings), np.asarray(free.first())

    figure, (left, right) = canvas(3.6, 1, 2)
    for axes, place, reach in ((left, X, 0.08), (right, NOISE, 0.7)):
        values = start[place] + reach * np.linspace(-1, 1, 21)
        shown = np.exp if place == NOISE else np.asarray
        # one program runs the recording with all 21 values at once
        errors = loss.values(np.where(np.arange(4) == place, values[:, None], start), recording)
        axes.plot(shown(values), 100 * errors, "o", ms=4, color="0.4", label="whole runs")
        for value in values[[4, 10, 16]]:
            found = loss(np.where(np.arange(4) == place, value, start), [recording])
            near = value + 0.25 * reach * np.array([-1, 1])
            tangent = found.value + found.gradient[place] * (near - value)
            axes.plot(shown(near), 100 * tangent, color="tab:red", lw=2.5, label="derivative")
    left.set(xlabel="x of the lever arm [m]", ylabel="ATE [cm]")
    right.set(xlabel="accelerometer noise\n[mm/s²/√Hz]", xscale="log")
    ticks = np.exp(start[NOISE]) * np.array([0.5, 1.0, 2.0])
    right.set_xticks(ticks, [f"{1e3 * tick:.2g}" for tick in ticks])
    right.minorticks_off()
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], loc="outside upper center", ncols=2, frameon=False)
    save(figure, out)


if __name__ == "__main__":
    main()
