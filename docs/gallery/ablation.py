"""Draw the ranking of an ablation: the error of each setting on each recording, and its mean."""

import tempfile
from pathlib import Path

import jax
from picture import canvas, legend_above, options, save

from lio_jax import run_ablation

SPEC = """
recipe: default
sequences:
  - {sim: street, duration: 4, beams: 16, columns: 512}
  - {sim: city, duration: 4, beams: 16, columns: 512}
seeds: [0, 1, 2]
grid:
  params.map.voxel_size: [0.6, 1.2, 2.4]      # m
  params.registration.kernel: [0.05, 0.15, 0.45]      # m
baseline: {params.map.voxel_size: 1.2, params.registration.kernel: 0.15}
metrics: [ate.rmse]
"""
COLOURS = {"street": "tab:blue", "city": "tab:orange"}


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as folder:
        spec = Path(folder) / "spec.yaml"
        spec.write_text(SPEC)
        comparison = run_ablation(spec, Path(folder) / "out")
    print(comparison)

    figure, (axes,) = canvas(4.4)
    for place, row in enumerate(comparison.rows):
        errors = comparison.values["ate.rmse"][row.variant]
        for name, colour in COLOURS.items():
            own = [1e3 * error for (recording, _), error in errors.items() if recording.startswith(name)]
            axes.plot(own, [place] * len(own), "o", color=colour, alpha=0.7, label="" if place else name)
        mean = 1e3 * row.means["ate.rmse"]
        axes.plot(mean, place, "|", color="black", ms=20, mew=3, label="" if place else "mean")
    axes.set_yticks(
        range(len(comparison.rows)), [row.variant.replace(" ", "\n") for row in comparison.rows], fontsize=9
    )
    axes.invert_yaxis()
    axes.set(xlabel="ATE [mm]", xscale="log")
    axes.set_xticks([1, 2, 5, 10], ["1", "2", "5", "10"])
    axes.minorticks_off()
    legend_above(axes, 3)
    save(figure, out)


if __name__ == "__main__":
    main()
