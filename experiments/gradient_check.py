"""Compare reported derivatives with the slope of the objective itself over a range of each parameter.

python experiments/gradient_check.py RECORDING [--objective ate] [--recipe default] [--set KEY=VALUE ...]
    [--params registration.kernel,extrinsics.translation] [--widths 0.1 0.3] [--runs 9]
    [--start K] [--scans N]

Each parameter takes evenly spaced values around its own. The slope is that of the straight line through the
objective's values; its standard error tells how far they lie from the line. A positive parameter varies by
its logarithm, so a width of 0.3 is about 30 %; a length or a time varies by 0.07 of the width (m, s), an
angle by 0.02 of it (rad). The last two columns show how often choices differ between neighbouring runs: the
share of inserted points that only one of the two inserted, and the share of scans with different numbers of
iterations.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lio_jax.commands.runtime import prepare_jax

PARAMETERS = (
    "registration.kernel,registration.information_scale,lidar.range_sigma,imu.gyro_noise,imu.accel_noise,"
    "extrinsics.translation"
)
LENGTH_SHARE, ANGLE_SHARE = 0.07, 0.02
"""Widths of the ranges of lengths and times (m, s) and of angles (rad), as shares of that of a logarithm."""


@dataclass(frozen=True)
class Slope:
    """The straight line through an objective's values."""

    slope: float
    sigma: float
    """Standard error of the slope."""
    points_differ: float
    """Share of the inserted points that only one of two neighbouring runs inserted."""
    iterations_differ: float
    """Share of the scans in which two neighbouring runs took different numbers of iterations."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--objective", default="ate")
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--params", default=PARAMETERS)
    parser.add_argument("--widths", type=float, nargs="+", default=[0.1, 0.3])
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--scans", type=int, default=None)
    options = parser.parse_args()
    if options.runs < 3:
        parser.error("--runs must be 3 or more: the error of a slope needs a third value.")
    prepare_jax()

    from lio_jax import open_sequence
    from lio_jax.run.run import settings_for
    from lio_jax.settings.settings import recipe_of, recipe_settings, with_overrides
    from lio_jax.tuning.gradient import wants_map
    from lio_jax.tuning.objectives import objective_named
    from lio_jax.tuning.parameters import free_parameters
    from lio_jax.tuning.recording import Recording
    from lio_jax.tuning.streaming import streaming_gradient

    given = with_overrides(recipe_settings(options.recipe), options.set)
    sequence = open_sequence(options.recording, given.run.data)
    settings, _ = settings_for(sequence, given)
    named, recipe = objective_named(options.objective), recipe_of(settings)
    free = free_parameters(settings.params(), options.params.split(","))
    recording = Recording(sequence, settings, options.start, options.scans)
    x = np.asarray(free.first())
    through_map = wants_map(named, free)
    reported = streaming_gradient(recipe, free, named.objective, jnp.asarray(x), recording, through_map)
    print(f"{options.objective} = {reported.value:.6g} over {len(recording)} scans, ", end="")
    print(f"map {'differentiated' if through_map else 'constant'}, {len(reported.unconverged)} unconverged")
    print(f"{'by':34s} {'width':>6s} {'reported':>11s} {'slope':>11s} {'sigma':>9s} {'ratio':>7s}", end="")
    print(f" {'points':>7s} {'iterations':>10s}")
    for component, (name, declared) in enumerate(zip(free.names, free.declared, strict=True)):
        for width in options.widths:
            scale = width * share_of(declared)
            offsets = np.linspace(-scale, scale, options.runs)
            rows = x + offsets[:, None] * (np.arange(len(x)) == component)
            found = slope_of(recipe, free, named.objective, jnp.asarray(rows), offsets, recording)
            derivative = reported.gradient[component]
            print(
                f"{name:34s} {scale:6.3f} {derivative:11.3e} {found.slope:11.3e} {found.sigma:9.1e} "
                f"{derivative / found.slope:7.2f} {found.points_differ:7.2%} {found.iterations_differ:10.1%}",
                flush=True,
            )


def share_of(declared: Any) -> float:
    """Return the width of a component's range as a share of that of a positive parameter."""
    if declared.tuned == "log":
        return 1.0
    return ANGLE_SHARE if declared.tuned == "turn" or declared.unit == "rad" else LENGTH_SHARE


def slope_of(recipe: Any, free: Any, objective: Any, rows: Any, offsets: np.ndarray, recording: Any) -> Slope:
    """Return the slope of an objective over vectors of parameters, which run side by side."""
    from lio_jax.recipes.transforms import batched
    from lio_jax.run.track import Compiled, run_steps

    params = jax.vmap(free)(rows)
    sums: Any = jax.tree.map(lambda leaf: jnp.stack([leaf] * len(rows)), objective.start())
    inserted, differing, iterations = 0, 0, []
    for fed, state, output in run_steps(Compiled(batched(recipe), params), recording.scan_inputs()):
        truth = recording.truth_at(fed.end_ns)
        sums = _added(objective, params, sums, state, output, fed.scan, truth)
        added = np.asarray(output.added)
        inserted += int(added[1:].sum())
        differing += int((added[1:] != added[:-1]).sum())
        iterations.append(np.asarray(output.registration.iterations))
    values = np.asarray(jax.vmap(objective.value)(sums))
    (slope, level), squared = np.polyfit(offsets, values, 1), offsets @ offsets
    left = values - level - slope * offsets
    taken = np.array(iterations)
    return Slope(
        slope=float(slope),
        sigma=float(np.sqrt(left @ left / (len(values) - 2) / squared)),
        points_differ=differing / max(inserted, 1),
        iterations_differ=float(np.mean(taken[:, 1:] != taken[:, :-1])),
    )


def _added(objective: Any, params: Any, sums: Any, state: Any, output: Any, scan: Any, truth: Any) -> Any:
    from lio_jax.tuning.objectives import Observed

    def add(params: Any, sums: Any, state: Any, output: Any) -> Any:
        return objective.add(sums, Observed.of(state, output).with_scan(scan, params), truth)

    return jax.vmap(add)(params, sums, state, output)


if __name__ == "__main__":
    main()
