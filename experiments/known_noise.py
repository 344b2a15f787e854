"""Simulated recordings with known noise, the parameters that recipes can find, and checks of a result."""

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

# the MEMS sensor of LIO-SAM's recordings, with the densities of LIO-SAM's configuration
DENSITIES = {
    "gyro_noise": 1.5636e-3,
    "accel_noise": 3.99395e-3,
    "gyro_bias_walk": 3.564e-5,
    "accel_bias_walk": 6.4357e-5,
}
RANGE_SIGMA = 0.02
TRUE = {**{f"imu.{name}": value for name, value in DENSITIES.items()}, "lidar.range_sigma": RANGE_SIGMA}
SURFACE = "lidar.surface_sigma"
BLOCKS = {"pose": slice(0, 6), "velocity": slice(6, 9), "biases": slice(9, 15)}
SETTLED = 20
"""Number of scans after which the start no longer affects the estimate."""
_MOMENT_NS = 10_000_000
SIZE = {"beams": 32, "columns": 1024}


@dataclass(frozen=True)
class Tuning:
    """The parameters of a recipe that are tuned, and the objective."""

    free: tuple[str, ...]
    objective: str


TUNINGS = {
    "default": Tuning((*TRUE, "registration.information_scale"), "noise"),
    "lio_sam": Tuning(("imu.*_noise", "imu.*_walk", "registration.information_scale"), "marginal"),
}
"""Tunings by recipe. The true noise of a scan match is not known, so its scale is tuned as well."""


@dataclass(frozen=True)
class Found:
    """Result of a tuning."""

    x: np.ndarray
    sigma: np.ndarray
    losses: list[float]
    scans: int


@dataclass(frozen=True)
class Judged:
    """Consistency and errors of a filter on one recording."""

    ate_mm: float
    nees: dict[str, float]
    nis: float
    """Normalised innovation squared per degree of freedom; NaN for a recipe without innovations."""


class Workshop:
    """Recordings and compiled programs that all tunings of one objective share."""

    def __init__(
        self, recipe: str, seconds: float, objective: str, world: str, surface: bool = False
    ) -> None:
        from lio_jax.settings.settings import with_overrides
        from lio_jax.tuning.gradient import Loss
        from lio_jax.tuning.objectives import objective_named
        from lio_jax.tuning.parameters import free_parameters

        self.seconds = seconds
        self._recipe, tuning = recipe, TUNINGS[recipe]
        self._recordings: dict[tuple[str, int], Any] = {}
        self.settings = self._settings(self._sequence(world, 0))
        start = with_overrides(self.settings, [f"params.{SURFACE}={RANGE_SIGMA}"] if surface else [])
        self.free = free_parameters(start.params(), (*tuning.free, SURFACE) if surface else tuning.free)
        named = objective_named(objective)
        self.loss = Loss(self.settings.recipe, self.settings.config, self.free, named.objective)

    def recording(self, world: str, seed: int) -> Any:
        """Return a simulated recording, which is ray cast once."""
        from lio_jax.tuning.recording import Recording

        if (world, seed) not in self._recordings:
            sequence = self._sequence(world, seed)
            self._recordings[world, seed] = Recording(sequence, self._settings(sequence)), sequence
        return self._recordings[world, seed]

    def start(self, factor: float) -> np.ndarray:
        """Return all noise at ``factor`` times its true value; the surfaces' noise is that of the ranges."""
        x = np.asarray(self.free.first()).copy()
        for place, name in enumerate(self.free.names):
            if name in TRUE or name == SURFACE:
                x[place] = np.log(TRUE.get(name, RANGE_SIGMA) * factor)
        return x

    def tuned(self, world: str, seed: int, factor: float, iterations: int) -> Found:
        """Tune on one recording."""
        from lio_jax.tuning.optimise import Bounds, fisher_information, fisher_scoring

        recording, _ = self.recording(world, seed)
        evaluated: list[tuple[np.ndarray, Any]] = []

        def evaluate(x: np.ndarray) -> Any:
            evaluated.append((x, self.loss(x, [recording])))
            return evaluated[-1][1]

        x = self.start(factor)
        fisher_scoring(evaluate, x, Bounds(x - np.log(1e3), x + np.log(1e3)), iterations)
        x, last = evaluated[-1]
        sigma = np.sqrt(np.diag(np.linalg.inv(fisher_information(last))))
        losses = [result.value for _, result in evaluated]
        return Found(x, sigma, losses, sum(result.scans for _, result in evaluated))

    def judged(self, x: np.ndarray | None, world: str, seed: int) -> Judged:
        """Run with the parameters of ``x``, or with the shipped ones for None, and compare with the truth."""
        from lio_jax.core.error_state import local
        from lio_jax.evaluation.trajectory_error import align, nees, position_errors
        from lio_jax.run.compiled import CompiledStep
        from lio_jax.run.track import run_steps

        recording, sequence = self.recording(world, seed)
        arrays, motion = sequence.truth_arrays(), sequence.truth()
        step = CompiledStep(self.settings)
        step.params = self.settings.params() if x is None else self.free(jnp.asarray(x))
        poses, truth, errors, covariances, nis = [], [], [], [], []
        anchor = None
        for fed, state, output in run_steps(step, recording.scan_inputs()):
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
            nis=float(nis_sum / dof_sum) if dof_sum else np.nan,
        )

    def simplex(self, world: str, seed: int, factor: float, scans: int) -> list[tuple[int, float]]:
        """Return the best loss over the scans processed for Nelder & Mead's method with the same budget."""
        recording, _ = self.recording(world, seed)
        course: list[tuple[int, float]] = []

        def value(x: np.ndarray) -> float:
            loss = float(self.loss.values(x[None], recording)[0])
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
        from lio_jax.run.run import settings_for
        from lio_jax.settings.settings import recipe_settings

        return settings_for(sequence, recipe_settings(self._recipe))[0]


def _at(arrays: dict[str, Any], name: str, stamp_ns: int) -> np.ndarray:
    place = int(np.argmin(np.abs(arrays["imu_stamp_ns"] - stamp_ns)))
    return np.asarray(arrays[name][place])
