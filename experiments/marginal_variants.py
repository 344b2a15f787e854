"""Known noise as found by the marginal likelihood of whole recordings, for several models of a match's error.

    python experiments/marginal_variants.py [--world street] [--seeds 0 1 2] [--seconds 20] [--factor 10]
        [--json FILE]

Runs lio_sam once on each simulated recording, keeps its matched poses as measurements, and maximises the
likelihood of all samples and matches over all recordings together. The biases' walks are fixed at their true
values except in the last row. "truth" replaces the matches by the true poses with white noise: its error is a
lower bound for every method. Each cell is the ratio of the found to the true value, with the standard
deviation from the likelihood's curvature.
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from batch_evidence import STILL, Noise, Sweep, Terms, linearised, log_evidence
from known_noise import DENSITIES, Workshop
from scipy.optimize import minimize

from lio_jax.commands.runtime import prepare_jax
from lio_jax.estimation.chain import Chain
from lio_jax.estimation.factors import PoseMeasurement
from lio_jax.estimation.marginal_prior import gaussian_prior
from lio_jax.estimation.motion_state import MotionState
from lio_jax.estimation.smoother import smooth
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import preintegrate_parallel
from lio_jax.imu.sampling import sample_intervals

TYPICAL = np.repeat([5e-4, 2.5e-3], 3)
"""Typical standard deviations of a scan match, rad and m."""
TYPICAL_DRIFT = np.repeat([5e-4, 3e-3], 3)
"""Typical drift of the map, rad/sqrt(s) and m/sqrt(s)."""
LEAST = 3e-5
"""Least standard deviation, rad or m: a match's error seems to vanish where a motion's error replaces it."""
GRAVITY = np.array([0.0, 0.0, -9.80665])
PRIOR_SIGMA = np.repeat([0.03, 0.03, 3.0, 0.01, 0.1], 3)
"""Prior standard deviations of the first state, rad, m, m/s, rad/s, m/s^2."""


class Variant(NamedTuple):
    """A model of a scan match's error besides white noise."""

    name: str
    tilt: bool = False
    lag: bool = False
    per_axis: bool = False
    drift: bool = False
    walks: bool = False
    """Whether the biases' walks are estimated, too."""


VARIANTS = (
    Variant("white noise"),
    Variant("+ tilted world", tilt=True),
    Variant("+ sweep lag", tilt=True, lag=True),
    Variant("+ per axis", tilt=True, lag=True, per_axis=True),
    Variant("+ drifting map", lag=True, per_axis=True, drift=True),
    Variant("+ unknown walks", lag=True, per_axis=True, drift=True, walks=True),
)


def noise_of(variant: Variant, x: Any) -> Noise:
    """Return the noise for a vector of logarithms: four densities, match, drift."""
    size = 6 if variant.per_axis else 2
    blocks = [jnp.exp(part) for part in (x[:4], x[4 : 4 + size], x[4 + size :])]
    match, drift = (part if variant.per_axis else jnp.repeat(part, 3) for part in blocks[1:])
    imu = ImuParams(*blocks[0], gravity=jnp.asarray(-GRAVITY[2]))
    return Noise(imu, match, drift if variant.drift else STILL if variant.tilt else None)


def fitted(variant: Variant, recordings: list[Terms], factor: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the most likely logarithms, their standard deviations, and the log-likelihood."""

    @jax.jit
    def single(x: Any, terms: Terms) -> Any:
        return jax.value_and_grad(lambda x: -log_evidence(terms, noise_of(variant, x), variant.lag))(x)

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        values = [single(jnp.asarray(x), terms) for terms in recordings]
        return sum(float(value) for value, _ in values), np.sum([slope for _, slope in values], axis=0)

    pick = slice(None) if variant.per_axis else slice(None, None, 3)
    # fixed parameters stay at their true values
    scale = np.array([factor, factor, *[factor if variant.walks else 1.0] * 2])
    parts = [scale * np.array(list(DENSITIES.values())), TYPICAL[pick]]
    start = np.log(np.concatenate([*parts, TYPICAL_DRIFT[pick]] if variant.drift else parts))
    bounds = [(v - 9 if k < 4 else np.log(LEAST), v + 9) for k, v in enumerate(start)]
    if not variant.walks:
        bounds[2:4] = [(v, v) for v in start[2:4]]
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 150})
    free = np.array([low < high for low, high in bounds])
    steps = 1e-3 * np.eye(len(start))[free]
    curvature = np.stack([(loss(found.x + d)[1] - loss(found.x - d)[1])[free] / 2e-3 for d in steps])
    covariance = np.linalg.pinv((curvature + curvature.T) / 2 + 1e-6 * np.eye(len(curvature)))
    sigma = np.zeros(len(start))
    sigma[free] = np.sqrt(np.abs(np.diag(covariance)))
    return found.x, sigma, -found.fun


def gathered(shop: Workshop, world: str, seed: int) -> tuple[Sweep, jaxlie.SE3, jaxlie.SE3]:
    """Run lio_sam and return the measurements: sweeps, matched poses, and the true poses."""
    from lio_jax.run.compiled import CompiledStep
    from lio_jax.run.track import run_steps

    recording, _ = shop.recording(world, seed)
    step = CompiledStep(shop.settings)
    cut = jax.jit(sample_intervals)
    sweeps, matched, true = [], [], []
    latest = None
    for fed, state, _ in run_steps(step, recording.scan_inputs()):
        truth = recording.truth_at(fed.end_ns)
        if not bool(truth.known):
            break
        span = np.array([fed.scan.duration - fed.scan.interval, fed.scan.duration], float)
        if latest is not None:
            intervals = cut(fed.imu, state.nav.time_offset, *jnp.asarray(span))
            sweeps.append(Sweep(intervals, latest, jnp.asarray(span)))
        latest = jax.tree.map(np.asarray, state.window.latest())
        window = state.window.chain
        matched.append(np.asarray(window.lidar.T_world_imu.wxyz_xyz[window.count - 1]))
        true.append(np.asarray(truth.T_world_imu.wxyz_xyz))
    stacked = jax.tree.map(lambda *rows: jnp.stack([jnp.asarray(row) for row in rows]), *sweeps)
    return stacked, jaxlie.SE3(jnp.asarray(matched)), jaxlie.SE3(jnp.asarray(true))


def terms_of(sweeps: Sweep, poses: jaxlie.SE3) -> Terms:
    """Return a recording, linearised at the states smoothed with true densities and typical white noise."""
    imu = ImuParams(*map(jnp.asarray, DENSITIES.values()), gravity=jnp.asarray(-GRAVITY[2]))
    single = lambda i, s: preintegrate_parallel(i, s.gyro_bias, s.accel_bias, imu)  # noqa: E731
    links = jax.vmap(single)(sweeps.intervals, sweeps.start)
    links = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[-1:]]), links)
    place = poses.translation()
    count = len(place)
    velocity = jnp.gradient(place, axis=0) / jnp.mean(links.duration)
    zero = jnp.zeros_like(velocity)
    guess = MotionState(poses, velocity, zero, zero)
    prior = gaussian_prior(jax.tree.map(lambda rows: rows[0], guess), jnp.diag(jnp.asarray(PRIOR_SIGMA**2)))
    lidar = PoseMeasurement(
        poses,
        jnp.broadcast_to(jnp.diag(jnp.asarray(TYPICAL**-2)), (count, 6, 6)),
        jnp.full(count, jnp.inf),
        jnp.ones(count, bool),
    )
    chain = Chain(jnp.int32(count), jnp.asarray(GRAVITY), prior, links, lidar)
    found = jax.jit(lambda c, g: smooth(c, g, max_iterations=50, tolerance=jnp.array(1e-6)))(chain, guess)
    return linearised(chain, found.states, sweeps)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--world", default="street")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--factor", type=float, default=10.0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    prepare_jax()
    jax.config.update("jax_enable_x64", True)
    shop = Workshop("lio_sam", options.seconds, "marginal", options.world)
    held = [gathered(shop, options.world, seed) for seed in options.seeds]
    noise = np.random.default_rng(0).normal(size=(len(held), len(held[0][2].wxyz_xyz) + 1, 6))
    # jaxlie stores the translation before the rotation
    twists = (noise * TYPICAL)[..., [3, 4, 5, 0, 1, 2]]
    ideal = [
        terms_of(sweeps, true @ jaxlie.SE3.exp(jnp.asarray(twist[: len(true.wxyz_xyz)])))
        for (sweeps, _, true), twist in zip(held, twists, strict=True)
    ]
    matched = [terms_of(sweeps, poses) for sweeps, poses, _ in held]
    print(f"\n{options.world}, {len(held)} x {options.seconds:g} s: found / true, from {options.factor:g} x")
    print(f"{'':18}" + "".join(f"{name:>22}" for name in DENSITIES) + f"{'log-likelihood':>16}")
    report: dict[str, Any] = {}
    for name, variant, terms in [("truth", VARIANTS[0], ideal), *((v.name, v, matched) for v in VARIANTS)]:
        x, sigma, likelihood = fitted(variant, terms, options.factor)
        ratio = np.exp(x[:4]) / np.array(list(DENSITIES.values()))
        cells = (
            f"{r:.3g} +- {100 * s:.2g} %" for r, s in zip(ratio, np.minimum(sigma[:4], 9.99), strict=True)
        )
        print(f"{name:18}" + "".join(f"{cell:>22}" for cell in cells) + f"{likelihood:16.1f}", flush=True)
        report[name] = {"ratio": ratio.tolist(), "sigma": sigma.tolist(), "sigmas": np.exp(x[4:]).tolist()}
    if options.json:
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
