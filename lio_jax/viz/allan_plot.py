"""The Allan deviation of an inertial sensor as PNG."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.imu.allan import NoiseFit
from lio_jax.viz.plot import _figure, _save


class Noise(Protocol):
    """What is drawn of one sensor."""

    @property
    def tau(self) -> NDArray[np.float64]:
        """(k,) averaging times, s."""
        ...

    @property
    def deviation(self) -> NDArray[np.float64]:
        """(k, 3) Allan deviation of the axes."""
        ...

    @property
    def combined(self) -> NoiseFit:
        """Fit to the axes' mean variance."""
        ...


def plot_allan(path_png: Path, noises: Mapping[str, Noise], title: str) -> None:
    """Draw each sensor's Allan deviation, the fit and the two densities where they are read.

    Args:
        path_png: file to write, whole or not at all.
        noises: by name and unit.
        title: shown above.
    """
    figure = _figure(6.0 * len(noises), 5.0)
    figure.suptitle(title)
    for axes, (name, noise) in zip(np.ravel(figure.subplots(1, len(noises))), noises.items(), strict=True):
        fit = noise.combined
        for axis, colour in enumerate(("tab:red", "tab:green", "tab:blue")):
            axes.loglog(
                noise.tau, noise.deviation[:, axis], ".-", color=colour, label="xyz"[axis], markersize=3
            )
        low, high = float(np.nanmin(noise.deviation)), float(np.nanmax(noise.deviation))
        span = np.geomspace(min(noise.tau[0], 1.0), max(noise.tau[-1], 3.0), 200)
        axes.loglog(span, fit.deviation(span), "k-", linewidth=2.0, label="fit, axes combined", alpha=0.7)
        white = f"white noise {fit.white:.2e}/sqrt(Hz)"
        axes.loglog(span, fit.white / np.sqrt(span), "k:", label=white)
        axes.plot(1.0, fit.white, "ko", markersize=5)
        if fit.walk is not None:
            walk = f"bias random walk {fit.walk:.2e}/s/sqrt(Hz)"
            axes.loglog(span, fit.walk * np.sqrt(span / 3), "k--", label=walk)
            axes.plot(3.0, fit.walk, "ks", markersize=5)
            low = min(low, fit.walk)
        axes.set_ylim(low / 2, high * 2)
        axes.set_xlabel("averaging time [s]")
        axes.set_ylabel("Allan deviation")
        axes.set_title(name, fontsize="medium")
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(loc="best", fontsize="small")
    _save(figure, path_png)
