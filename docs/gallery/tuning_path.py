"""Draw the paths of two tunings over their objective, from wrong noise of an IMU to the true one."""

import jax
import numpy as np
from picture import canvas, legend_above, options, save

from lio_jax import (
    Bounds,
    ImuModel,
    Loss,
    Recording,
    SimulatedSequence,
    fisher_scoring,
    free_parameters,
    objective_named,
    recipe_settings,
    settings_for,
    with_overrides,
)

NAMES = ["imu.gyro_noise", "imu.accel_noise"]
SMALL = [
    "config.map.capacity=32768",
    "config.imu.registration_points=1024",
    "config.imu.insertion_points=4096",
]
LEVELS = (0, 0.03, 0.06, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""Levels of the objective that are drawn."""
STARTS = {"tab:orange": (8.0, 6.0), "tab:red": (0.15, 5.0)}
"""Factors of the true noise at which a tuning starts, by its colour."""


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    model = ImuModel()
    drive = SimulatedSequence(
        "city", duration_s=10.0, seed=1, beams=16, columns=512, imu=model, moving_start=True
    )
    settings, _ = settings_for(drive, with_overrides(recipe_settings("default"), SMALL))
    free = free_parameters(settings.params(), NAMES)
    loss = Loss(settings.recipe, settings.config, free, objective_named("pose").objective)
    recording, true = Recording(drive, settings), np.log([model.gyro_noise, model.accel_noise])

    figure, (axes,) = canvas(4.6)
    gyro, accel = np.log(np.geomspace(0.1, 12, 9)), np.log(np.geomspace(0.3, 16, 8))
    # one program runs the recording with a row of values at once
    values = [loss.values(true + np.column_stack([gyro, np.full(9, one)]), recording) for one in accel]
    filled = axes.contourf(
        np.exp(gyro), np.exp(accel), values - np.min(values), LEVELS, cmap="Blues", extend="max"
    )
    for place, (colour, factors) in enumerate(STARTS.items(), 1):
        visited: list[np.ndarray] = []

        def evaluate(x: np.ndarray, visited: list[np.ndarray] = visited):
            visited.append(np.exp(x - true))
            return loss(x, [recording])

        fisher_scoring(evaluate, true + np.log(factors), Bounds(true - 3, true + 3), 8)
        axes.plot(*np.array(visited).T, "o-", color=colour, lw=2, ms=5, label=f"tuning {place}")
        print(f"start {factors}, end {visited[-1].round(2)} times the true noise, {len(visited)} evaluations")
    axes.plot(1, 1, "*", color="black", ms=15, label="true noise")
    axes.set(xlabel="gyroscope noise, factor of the truth", ylabel="accelerometer noise, factor of the truth")
    for scale, ticks in ((axes.xaxis, (0.1, 0.3, 1, 3, 10)), (axes.yaxis, (0.3, 1, 3, 10))):
        scale.axes.set(**{f"{scale.axis_name}scale": "log"})
        scale.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
        scale.set_ticks([], minor=True)
    figure.colorbar(filled, label="objective above its lowest value")
    legend_above(axes, 3)
    save(figure, out)


if __name__ == "__main__":
    main()
