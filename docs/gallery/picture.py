"""What the scripts of the gallery share: their options, a run, the truth in the run's frame, and the file."""

import argparse
import io
import tempfile
from collections.abc import Sequence as Listing
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from lio_jax import (
    RunResult,
    Sequence,
    Sink,
    Trajectory,
    evaluate,
    recipe_settings,
    run_sequence,
    settings_for,
    with_overrides,
)

TRUTH, ESTIMATE, BEFORE = "black", "tab:blue", "tab:orange"
"""Colours of the truth, of an estimate, and of what the estimate was before a correction or without it."""
_COLOURS = 256

plt.rcParams.update({"font.size": 11, "legend.fontsize": 10, "axes.grid": True, "grid.alpha": 0.3})


def options(script: str, *paths: str) -> argparse.Namespace:
    """Return the options of a script: ``out``, and the paths that it needs by their names."""
    parser = argparse.ArgumentParser()
    for name in paths:
        parser.add_argument(name, type=Path)
    parser.add_argument("--out", type=Path, default=Path(script).with_suffix(".png"), help="the PNG file")
    return parser.parse_args()


def canvas(height: float, rows: int = 1, columns: int = 1, **kwargs: object) -> tuple[plt.Figure, np.ndarray]:
    """Return a figure as wide as a page, ``height`` inches high, and its panels, (rows * columns,)."""
    figure, panels = plt.subplots(
        rows, columns, figsize=(5.8, height), layout="constrained", squeeze=False, **kwargs
    )
    return figure, panels.ravel()


def legend_above(axes: plt.Axes, columns: int) -> None:
    """Put the legend above the panel, where it covers no data."""
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, frameon=False)


def save(figure: plt.Figure, out: Path) -> None:
    """Write a figure as a PNG of few colours, which is a third of the size."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=120)
    plt.close(figure)
    out.parent.mkdir(parents=True, exist_ok=True)
    image = Image.open(buffer).convert("RGB")
    image.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(out, optimize=True)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


def run(
    sequence: Sequence, *overrides: str, folder: Path | None = None, sinks: Listing[Sink] = ()
) -> RunResult:
    """Run the default recipe on a recording, and print the error where the truth is known.

    Args:
        sequence: the recording.
        overrides: settings as on the command line, ``PATH=VALUE``.
        folder: keeps the files of the run; None: nobody needs them.
        sinks: take each scan's result.
    """
    settings, _ = settings_for(sequence, with_overrides(recipe_settings("default"), list(overrides)))
    with tempfile.TemporaryDirectory() as unused:
        result = run_sequence(sequence, settings, folder or Path(unused), sinks=sinks)
    truth = sequence.truth()
    for name, trajectory in (("before the correction", result.odometry), ("estimate", result.trajectory)):
        if truth is not None and trajectory is not None:
            print(f"{name}: ATE {evaluate(trajectory, truth).ate.rmse:.4f} m", flush=True)
    return result


def seconds(trajectory: Trajectory) -> np.ndarray:
    """Return the time of each pose since the first one, (n,) s."""
    return (trajectory.stamp_ns - trajectory.stamp_ns[0]) * 1e-9


def in_run_frame(truth: Trajectory, trajectory: Trajectory) -> Trajectory:
    """Return the truth at the stamps of an estimate, moved so that both begin with the same pose."""
    truth = truth.at(trajectory.stamp_ns)
    start = trajectory.at(truth.stamp_ns[:1]).poses[0]
    return Trajectory(truth.stamp_ns, start @ np.linalg.inv(truth.poses[0]) @ truth.poses)
