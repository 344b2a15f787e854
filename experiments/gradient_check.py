"""Compare reported derivatives with the slope of the objective itself over a range of each parameter.

python experiments/gradient_check.py RECORDING [--objective ate] [--recipe default] [--set KEY=VALUE ...]
    [--params registration.kernel,extrinsics.translation] [--widths 0.1 0.3] [--draws 10] [--seed K]
    [--start K] [--scans N]

The derivative holds the choices of a run, such as which point is matched with which plane. The objective has
a small jump wherever a choice changes. Along one line through the parameters, the jumps are the same however
many runs lie on it: more runs do not average them, and their distances from a straight line are correlated.
The script therefore draws the choices anew several times and repeats the comparison. Each draw changes the
edges of the cubes by which points are thinned and the map is divided, by a few per cent. The parameters that
have a derivative stay as they are given.

In each draw, the derivative is compared with the slope between the two ends of a range around the parameter.
The ends lie symmetrically, so a curvature of the objective has no effect. The columns are

    derivative  mean over the draws
    spread      standard deviation of the derivative between draws: the error of a single derivative
    slope       mean over the draws, and its standard error
    ratio       derivative / slope
    off by      mean difference of derivative and slope in the same draw, in its standard errors
    points      share of the inserted points that only the run at one of the two ends inserted
    iterations  share of the scans that took different numbers of iterations at the two ends

A positive parameter varies by its logarithm, so a width of 0.3 is about 30 %. A length or a time varies by
0.07 of the width (m, s), and an angle by 0.02 of it (rad).
"""

import argparse
from dataclasses import dataclass, replace
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
CUBE_SIGMA = 0.03
"""Standard deviation of the logarithm of a cube's edge."""
LENGTH_SHARE, ANGLE_SHARE = 0.07, 0.02
"""Widths of the ranges of lengths and times (m, s) and of angles (rad), as shares of that of a logarithm."""


@dataclass(frozen=True)
class Ends:
    """Pairs of runs at the two ends of a range."""

    values: np.ndarray
    """(n, 2) the objective."""
    points_differ: np.ndarray
    """(n,) share of the inserted points that only one of the two inserted."""
    iterations_differ: np.ndarray
    """(n,) share of the scans in which the two took different numbers of iterations."""


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
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--scans", type=int, default=None)
    options = parser.parse_args()
    if options.draws < 3:
        parser.error("--draws must be 3 or more: the error of a mean needs a third value.")
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
    share = np.array([share_of(declared) for declared in free.declared])
    random = np.random.default_rng(options.seed)
    draws = [with_other_cubes(free, random) for _ in range(options.draws)]
    about = named.objective, jnp.asarray(x), recording, through_map
    reported = [streaming_gradient(recipe, draw, *about) for draw in draws]
    derivatives = np.array([one.gradient for one in reported])
    value, unconverged = np.mean([(one.value, len(one.unconverged)) for one in reported], 0)
    print(f"{options.objective} = {value:.6g} over {len(recording)} scans, ", end="")
    print(f"map {'differentiated' if through_map else 'constant'}, {unconverged:.1f} unconverged")
    print(f"{'by':34s} {'width':>6s} {'derivative':>10s} {'spread':>8s} {'slope':>10s} {'+-':>8s}", end="")
    print(f" {'ratio':>6s} {'off by':>6s} {'points':>7s} {'iterations':>10s}", flush=True)
    for width in options.widths:
        steps = np.diag(width * share)
        pairs = x + np.stack([steps, -steps], 1)
        ends = [ends_of(recipe, draw, named.objective, pairs, recording) for draw in draws]
        slopes = np.array([one.values[:, 0] - one.values[:, 1] for one in ends]) / (2 * width * share)
        apart, apart_error = mean_and_error(derivatives - slopes)
        slope, slope_error = mean_and_error(slopes)
        points = np.mean([one.points_differ for one in ends], 0)
        iterations = np.mean([one.iterations_differ for one in ends], 0)
        derivative, spread = derivatives.mean(0), derivatives.std(0, ddof=1)
        for k, name in enumerate(free.names):
            print(
                f"{name:34s} {steps[k, k]:6.3f} {derivative[k]:10.2e} {spread[k]:8.1e} {slope[k]:10.2e} "
                f"{slope_error[k]:8.1e} {derivative[k] / slope[k]:6.2f} {apart[k] / apart_error[k]:6.1f} "
                f"{points[k]:7.2%} {iterations[k]:10.1%}",
                flush=True,
            )


def with_other_cubes(free: Any, random: np.random.Generator) -> Any:
    """Return the parameters with other edges of the cubes that thin points and divide the map."""

    def drawn(path: Any, leaf: Any) -> Any:
        edge = str(path[-1]).endswith(("spacing", "voxel_size"))
        return leaf * float(np.exp(CUBE_SIGMA * random.normal())) if edge else leaf

    return replace(free, start=jax.tree_util.tree_map_with_path(drawn, free.start))


def share_of(declared: Any) -> float:
    """Return the width of a component's range as a share of that of a positive parameter."""
    if declared.tuned == "log":
        return 1.0
    return ANGLE_SHARE if declared.tuned == "turn" or declared.unit == "rad" else LENGTH_SHARE


def mean_and_error(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of independent rows and its standard error."""
    return rows.mean(0), rows.std(0, ddof=1) / np.sqrt(len(rows))


def ends_of(recipe: Any, free: Any, objective: Any, pairs: np.ndarray, recording: Any) -> Ends:
    """Return what runs at pairs of parameter vectors, (n, 2, p), lead to; all run side by side."""
    from lio_jax.recipes.transforms import batched
    from lio_jax.run.compiled import Compiled
    from lio_jax.run.track import run_steps

    rows = jnp.asarray(pairs.reshape(-1, pairs.shape[-1]))
    params = jax.vmap(free)(rows)
    sums: Any = jax.tree.map(lambda leaf: jnp.stack([leaf] * len(rows)), objective.start())
    inserted, differing, iterations = 0, 0, []
    for fed, state, output in run_steps(Compiled(batched(recipe), params), recording.scan_inputs()):
        truth = recording.truth_at(fed.end_ns)
        scan = jax.tree.map(jnp.asarray, fed.scan)
        sums = _added(objective, params, sums, state, output, scan, truth)
        added = np.asarray(output.added).reshape(len(pairs), 2, -1)
        inserted = inserted + added.sum((1, 2)) / 2
        differing = differing + (added[:, 0] != added[:, 1]).sum(1)
        iterations.append(np.asarray(output.registration.iterations).reshape(-1, 2))
    taken = np.array(iterations)
    return Ends(
        values=np.asarray(jax.vmap(objective.value)(sums)).reshape(-1, 2),
        points_differ=differing / np.maximum(inserted, 1),
        iterations_differ=np.mean(taken[..., 0] != taken[..., 1], 0),
    )


def _added(objective: Any, params: Any, sums: Any, state: Any, output: Any, scan: Any, truth: Any) -> Any:
    from lio_jax.tuning.objectives import Observed

    def add(params: Any, sums: Any, state: Any, output: Any) -> Any:
        return objective.add(sums, Observed.of(state, output).with_scan(scan, params), truth)

    return jax.vmap(add)(params, sums, state, output)


if __name__ == "__main__":
    main()
