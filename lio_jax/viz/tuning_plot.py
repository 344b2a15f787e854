"""How a tuning went: the loss, and each parameter on its way, as PNG."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.viz.plot import _figure, _save


def plot_tuning(
    path_png: Path,
    losses: Mapping[str, NDArray[np.float64]],
    parameters: Mapping[str, NDArray[np.float64]],
    intervals: Mapping[str, tuple[float, float]],
    best: int,
) -> None:
    """Draw the losses and, one panel each, the parameters over the evaluations.

    Args:
        path_png: file to write, whole or not at all.
        losses: (n,) by name.
        parameters: (n,) values by name; positive ones are drawn on a log scale.
        intervals: 95 % interval of the best value by name, where it is known.
        best: which evaluation was taken.
    """
    panels = 1 + len(parameters)
    columns = min(3, panels)
    rows = -(-panels // columns)
    figure = _figure(4.2 * columns, 3.0 * rows)
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for name, values in losses.items():
        axes[0].plot(values, ".-", label=name)
    axes[0].set_title("loss", fontsize="medium")
    axes[0].legend(fontsize="small")
    for panel, (name, values) in zip(axes[1:], parameters.items(), strict=False):
        panel.plot(values, ".-", color="tab:blue")
        if np.all(values > 0):
            panel.set_yscale("log")
        if name in intervals:
            low, high = intervals[name]
            panel.axhspan(low, high, color="tab:blue", alpha=0.15, label="95 % interval")
            panel.legend(fontsize="small")
        panel.set_title(name, fontsize="medium")
    for panel in axes[:panels]:
        panel.axvline(best, color="k", linewidth=0.8, linestyle=":")
        panel.set_xlabel("evaluation")
        panel.grid(True, which="both", alpha=0.25)
    for panel in axes[panels:]:
        panel.set_axis_off()
    _save(figure, path_png)
