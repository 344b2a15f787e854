"""Find known noise again without ground truth, and judge it on recordings that it was not tuned on.

    python experiments/tune_noise.py [--worlds street city] [--seeds 0 1 2] [--held-out 100 101 102]
        [--seconds 20] [--factors 10 0.1] [--objectives noise] [--iterations 40] [--surface] [--simplex]
        [--json FILE]

Simulates recordings of a MEMS sensor, starts with all noise FACTOR times its true value and tunes on each
recording by itself. Tables: what was found over what is true; what the tuned filter says of itself on the
held-out recordings, and its trajectory's error there; and, with --simplex, the loss by scans processed beside
that of Nelder & Mead's method. All worlds run with the first one's voxels.
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from lio_jax.commands.runtime import prepare_jax

# the MEMS sensor of LIO-SAM's recordings, by the densities of its own configuration
DENSITIES = {
    "gyro_noise": 1.5636e-3,
    "accel_noise": 3.99395e-3,
    "gyro_bias_walk": 3.564e-5,
    "accel_bias_walk": 6.4357e-5,
}
RANGE_SIGMA = 0.02
TRUE = {**{f"imu.{name}": value for name, value in DENSITIES.items()}, "lidar.range_sigma": RANGE_SIGMA}
SURFACE = "lidar.surface_sigma"
TUNED = (*TRUE, "registration.information_scale")
BLOCKS = {"pose": slice(0, 6), "velocity": slice(6, 9), "biases": slice(9, 15)}
SETTLED = 20
"""Scans until the start has been forgotten."""
_MOMENT_NS = 10_000_000
SIZE = {"beams": 32, "columns": 1024}


@dataclass(frozen=True)
class Found:
    """A tuning's end."""

    x: np.ndarray
    sigma: np.ndarray
    losses: list[float]
    scans: int


@dataclass(frozen=True)
class Judged:
    """How a filter did on one recording."""

    ate_mm: float
    nees: dict[str, float]
    nis: float


class Workshop:
    """Recordings and compiled programs, shared by all tunings of one objective."""

    def __init__(self, seconds: float, objective: str, world: str, surface: bool = False) -> None:
        from lio_jax.core.settings import with_overrides
        from lio_jax.tuning.loss import Loss
        from lio_jax.tuning.named_objectives import objective_named
        from lio_jax.tuning.parameters import free_parameters
        from lio_jax.tuning.values import StreamingValues

        self.seconds = seconds
        self._recordings: dict[tuple[str, int], Any] = {}
        self.settings = self._settings(self._sequence(world, 0))
        start = with_overrides(self.settings, [f"params.{SURFACE}={RANGE_SIGMA}"] if surface else [])
        self.free = free_parameters(start.params(), (*TUNED, SURFACE) if surface else TUNED)
        named = objective_named(objective)
        arguments = (self.settings.recipe, self.settings.config, self.free, named.objective)
        self.loss, self.values = Loss(*arguments), StreamingValues(*arguments)
        self._step: Any = None

    def recording(self, world: str, seed: int) -> Any:
        """Return a simulated recording, cast once."""
        from lio_jax.tuning.recording import Recording

        if (world, seed) not in self._recordings:
            sequence = self._sequence(world, seed)
            self._recordings[world, seed] = Recording(sequence, self._settings(sequence)), sequence
        return self._recordings[world, seed]

    def start(self, factor: float) -> np.ndarray:
        """Return all noise at ``factor`` times its true value, the surfaces' at that of the ranges."""
        x = np.asarray(self.free.first()).copy()
        for place, name in enumerate(self.free.names):
            if name in TRUE or name == SURFACE:
                x[place] = np.log(TRUE.get(name, RANGE_SIGMA) * factor)
        return x

    def tuned(self, world: str, seed: int, factor: float, iterations: int) -> Found:
        """Tune on one recording."""
        from lio_jax.tuning.optimise import Bounds, fisher_information, scoring

        recording, _ = self.recording(world, seed)
        evaluated: list[tuple[np.ndarray, Any]] = []

        def evaluate(x: np.ndarray) -> Any:
            evaluated.append((x, self.loss(x, [recording])))
            return evaluated[-1][1]

        x = self.start(factor)
        scoring(evaluate, x, Bounds(x - np.log(1e3), x + np.log(1e3)), iterations)
        x, last = evaluated[-1]
        sigma = np.sqrt(np.diag(np.linalg.inv(fisher_information(last))))
        losses = [result.value for _, result in evaluated]
        return Found(x, sigma, losses, sum(result.scans for _, result in evaluated))

    def judged(self, x: np.ndarray | None, world: str, seed: int) -> Judged:
        """Run with the parameters of ``x``, or with the shipped ones, and compare with the truth."""
        from lio_jax.core.error_state import local
        from lio_jax.evaluation.alignment import align, position_errors
        from lio_jax.evaluation.consistency import nees
        from lio_jax.run.track import CompiledStep, stepped

        recording, sequence = self.recording(world, seed)
        arrays, motion = sequence.truth_arrays(), sequence.truth()
        self._step = step = self._step or CompiledStep(self.settings)
        step.params = self.settings.params() if x is None else self.free(jnp.asarray(x))
        poses, truth, errors, covariances, nis = [], [], [], [], []
        anchor = None
        for fed, state, output in stepped(step, recording.feed()):
            nav, true = state.nav, recording.truth_at(fed.end_ns).T_world_imu
            if anchor is None:
                # the first pose defines the map's frame
                anchor = nav.T_world_imu @ true.inverse()
            here = anchor @ true
            around = motion.at(fed.end_ns + np.array([-_MOMENT_NS, _MOMENT_NS])).positions
            if len(around) < 2:
                break
            velocity = (around[1] - around[0]) / (2e-9 * _MOMENT_NS)
            known = {
                "T_world_imu": here,
                "velocity": anchor.rotation() @ jnp.asarray(velocity),
                "gyro_bias": jnp.asarray(_at(arrays, "gyro_bias", fed.end_ns)),
                "accel_bias": jnp.asarray(_at(arrays, "accel_bias", fed.end_ns)),
            }
            errors.append(np.asarray(local(nav, replace(nav, **known)))[:15])
            covariances.append(np.asarray(output.covariance)[:15, :15])
            poses.append(np.asarray(nav.T_world_imu.as_matrix()))
            truth.append(np.asarray(true.as_matrix()))
            nis.append((float(output.nis), int(output.nis_dof)))
        error, covariance = np.array(errors)[SETTLED:], np.array(covariances)[SETTLED:]
        estimate, reference = np.array(poses), np.array(truth)
        off = position_errors(align(estimate, reference), estimate, reference)
        nis_sum, dof_sum = np.array(nis)[SETTLED:].sum(0)
        return Judged(
            ate_mm=1e3 * float(np.sqrt(np.mean(off**2))),
            nees={
                name: float(np.mean(nees(error[:, part], covariance[:, part, part])))
                / (part.stop - part.start)
                for name, part in BLOCKS.items()
            },
            nis=float(nis_sum / dof_sum),
        )

    def simplex(self, world: str, seed: int, factor: float, scans: int) -> list[tuple[int, float]]:
        """Return the best loss by scans processed of Nelder & Mead's method on the same budget."""
        recording, _ = self.recording(world, seed)
        course: list[tuple[int, float]] = []

        def value(x: np.ndarray) -> float:
            loss = float(self.values(x[None], recording)[0])
            best = min(loss, course[-1][1]) if course else loss
            course.append(((len(course) + 1) * len(recording), best))
            return loss

        runs = max(scans // len(recording), 2)
        minimize(value, self.start(factor), method="Nelder-Mead", options={"maxfev": runs, "xatol": 1e-3})
        return course

    def _sequence(self, world: str, seed: int) -> Any:
        from lio_jax import ImuModel, SimulatedSequence

        return SimulatedSequence(world, "generic32", self.seconds, seed, imu=ImuModel(**DENSITIES), **SIZE)

    def _settings(self, sequence: Any) -> Any:
        from lio_jax.core.settings import recipe_settings
        from lio_jax.run.run import settings_for

        return settings_for(sequence, recipe_settings("default"))[0]


def _at(arrays: dict[str, Any], name: str, stamp_ns: int) -> np.ndarray:
    place = int(np.argmin(np.abs(arrays["imu_stamp_ns"] - stamp_ns)))
    return np.asarray(arrays[name][place])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=["street", "city"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--held-out", nargs="*", type=int, default=[100, 101, 102])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--factors", nargs="+", type=float, default=[10.0, 0.1])
    parser.add_argument("--objectives", nargs="+", default=["noise"])
    parser.add_argument("--iterations", type=int, default=40)
    parser.add_argument("--surface", action="store_true", help=f"tune {SURFACE} too")
    parser.add_argument("--simplex", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    prepare_jax()
    jax.config.update("jax_enable_x64", True)
    report = {objective: tables(objective, options) for objective in options.objectives}
    if options.json:
        options.json.write_text(json.dumps(report, indent=1) + "\n")


def tables(objective: str, options: argparse.Namespace) -> dict[str, Any]:
    """Tune, judge and print for one objective."""
    shop = Workshop(options.seconds, objective, options.worlds[0], options.surface)
    names = [name.split(".")[1] for name in shop.free.names]
    true = np.array([np.log(TRUE.get(name, 1.0)) for name in shop.free.names])
    print(f"\nobjective {objective}: found / true [95 % interval]; surface (m) and scale as they are")
    print(f"{'world':8}{'seed':>5}{'start':>7}" + "".join(f"{name:>28}" for name in names) + f"{'s':>7}")
    found: list[Found] = []
    rows: list[dict[str, Any]] = []
    for world in options.worlds:
        for seed in options.seeds:
            for factor in options.factors:
                began = time.perf_counter()
                one = shop.tuned(world, seed, factor, options.iterations)
                # a walk that nothing is known of has no upper end
                with np.errstate(over="ignore"):
                    low, middle, high = (np.exp(one.x - true + k * one.sigma) for k in (-1.96, 0, 1.96))
                cells = (f"{m:.3g} [{a:.2g}, {b:.2g}]" for a, m, b in zip(low, middle, high, strict=True))
                line = "".join(f"{cell:>28}" for cell in cells)
                print(f"{world:8}{seed:5d}{factor:7g}{line}{time.perf_counter() - began:7.0f}", flush=True)
                found.append(one)
                rows.append({"world": world, "seed": seed, "factor": factor, "ratio": middle.tolist()})
    judged = judgement(shop, found, options)
    course = comparison(shop, found[0], options) if options.simplex else None
    return {"names": names, "recovered": rows, "judged": judged, "simplex": course}


def judgement(shop: Workshop, found: list[Found], options: argparse.Namespace) -> dict[str, Any]:
    """Run everything on the held-out recordings and print how sure and how right it is."""
    middle = np.median([one.x for one in found], axis=0)
    settings: dict[str, np.ndarray | None] = {
        f"{factor:g} x": shop.start(factor) for factor in options.factors
    }
    settings |= {"shipped": None, "tuned": middle}
    print("\nheld-out recordings: NEES and NIS per degree of freedom (1 is consistent), ATE in mm")
    print(f"{'':10}{'world':8}{'seed':>5}" + "".join(f"{name:>10}" for name in (*BLOCKS, "NIS", "ATE")))
    results: dict[str, Any] = {}
    for name, x in settings.items():
        for world in options.worlds:
            for seed in options.held_out:
                one = shop.judged(x, world, seed)
                figures = (*one.nees.values(), one.nis, one.ate_mm)
                print(f"{name:10}{world:8}{seed:5d}" + "".join(f"{v:10.3g}" for v in figures), flush=True)
                results[f"{name} {world} {seed}"] = figures
    return results


def comparison(shop: Workshop, scored: Found, options: argparse.Namespace) -> list[tuple[int, float]]:
    """Print the losses of scoring and of Nelder & Mead's method over the scans they processed."""
    world, seed, factor = options.worlds[0], options.seeds[0], options.factors[0]
    course = shop.simplex(world, seed, factor, scored.scans)
    length = len(shop.recording(world, seed)[0])
    print(f"\nbest loss by scans processed, {world} {seed} from {factor:g} x")
    print(f"{'scans':>8}{'scoring':>12}{'simplex':>12}")
    for place, loss in enumerate(np.minimum.accumulate(scored.losses)):
        beside = course[min(place, len(course) - 1)][1]
        print(f"{(place + 1) * length:8d}{loss:12.4f}{beside:12.4f}")
    return course


if __name__ == "__main__":
    main()
