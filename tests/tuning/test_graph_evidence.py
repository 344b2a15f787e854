"""The likelihood of the pose graph against a linear Gaussian model, and tuning by it without truth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.leaf import traced
from lio_jax.loops.back_end import BackEnd, Correction, Edge
from lio_jax.loops.edge_noise import odometry_covariance
from lio_jax.loops.gps import GpsGate
from lio_jax.loops.keyframe import Keyframe
from lio_jax.pose_graph.graph import ODOMETRY, POSITION, PRIOR
from lio_jax.settings.settings import recipe_settings, with_overrides
from lio_jax.settings.shared import GlobalParams
from lio_jax.tuning import corrected
from lio_jax.tuning.corrected import (
    CorrectedLoss,
    CorrectedRun,
    corrected_gradient,
    corrected_value,
    free_of_back_end,
)
from lio_jax.tuning.evaluated import Evaluated
from lio_jax.tuning.objectives import objective_named
from lio_jax.tuning.optimise import Bounds, covariance_by_curvature, lbfgsb
from lio_jax.tuning.replayed_graph import replayed_graph
from tests.loops.drives import LEVER, poses_at, to_enu
from tests.tuning.test_corrected import PATTERNS, run, stated

MARGINAL = objective_named("marginal")
COUNT = 12
STIFF = 1e-6
"""Standard deviation of rotations, rad, with which measurements are linear in the positions."""


def chain(rng, scale=2.0, sigma=0.2):
    """Return the replayed graph of a straight chain with fixes, its steps and its fixes.

    Its first pose is known to 0.5 m. The odometry states diagonal covariances.
    """
    variances = rng.uniform(0.01, 0.04, (COUNT - 1, 3))
    steps = np.array([1.0, 0, 0]) + rng.normal(size=(COUNT - 1, 3)) * scale * np.sqrt(variances)
    fixes = np.arange(COUNT)[:, None] * np.array([1.0, 0, 0]) + sigma * rng.normal(size=(COUNT, 3))
    edges = [Edge(PRIOR, 0, 0, np.eye(4), np.diag([STIFF**-2] * 3 + [0.5**-2] * 3))]
    for k, (step, variance) in enumerate(zip(steps, variances, strict=True)):
        stated = np.diag([STIFF**2] * 3 + variance.tolist())
        edges.append(Edge(ODOMETRY, k, k + 1, at(step), np.linalg.inv(stated), stated=stated))
    for k, fix in enumerate(fixes):
        edges.append(Edge(POSITION, k, k, at(fix), np.eye(6), np.zeros(3), np.zeros((6, 6))))
    poses = np.array([at([k, 0, 0]) for k in range(COUNT)])
    stamps = np.arange(COUNT)
    found = Correction(stamps, poses, poses, edges, np.ones(len(edges)), [], {}, None)
    return replayed_graph(found, stamps, poses, True), variances, steps, fixes


def at(position):
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


def params_with(scale, rotation_sigma, translation_sigma, min_variance):
    params = traced(GlobalParams, recipe_settings("default").values)
    backend = params.backend
    return eqx.tree_at(
        lambda p: (
            p.backend.odometry_scale,
            p.backend.odometry_rotation_sigma,
            p.backend.odometry_translation_sigma,
            p.gps.min_variance,
        ),
        params,
        tuple(
            jnp.asarray(value, backend.odometry_scale.dtype)
            for value in (scale, rotation_sigma, translation_sigma, min_variance)
        ),
    )


@pytest.mark.long
def test_it_is_the_likelihood_of_a_linear_gaussian_model():
    """Up to a constant: the fixes are normal about the odometry, its errors add up."""
    replayed, variances, steps, fixes = chain(np.random.default_rng(1))
    differences = []
    for scale, sigma, min_variance in [(1.0, 0.01, 0.04), (3.0, 0.1, 0.01), (0.5, 0.2, 1.0)]:
        value = float(replayed.negative_log_evidence(params_with(scale, STIFF, sigma, min_variance)))
        log_likelihood = 0.0
        for axis in range(3):
            errors = np.concatenate([[0.25], scale**2 * variances[:, axis] + sigma**2])
            to_position = np.tri(COUNT)
            covariance = to_position @ np.diag(errors) @ to_position.T + min_variance * np.eye(COUNT)
            mean = np.concatenate([[0], np.cumsum(steps[:, axis])])
            log_likelihood += multivariate_normal.logpdf(fixes[:, axis], mean, covariance)
        differences.append(value + log_likelihood)
    np.testing.assert_allclose(differences, differences[0], atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("elevation", [True, False], ids=["heights of the fixes", "heights of the odometry"])
def test_derivatives_are_central_differences(elevation):
    settings, _, replay, _ = run(True, elevation)
    free = free_of_back_end(settings, PATTERNS, MARGINAL)
    # a height's variance counts where it is above the least one
    x = free.first().at[free.names.index("gps.height_variance")].add(np.log(20.0))
    value, gradient = corrected_gradient(replay, free, MARGINAL.objective, x)
    assert value == pytest.approx(corrected_value(replay, free, MARGINAL.objective, x), rel=1e-12)
    for number, name in enumerate(free.names):
        step = jnp.zeros_like(x).at[number].set(8e-3)
        ends = [corrected_value(replay, free, MARGINAL.objective, x + k * step) for k in (-2, -1, 1, 2)]
        expected = np.dot(ends, [1, -8, 8, -1]) / (12 * 8e-3)
        assert gradient[number] == pytest.approx(expected, rel=1e-6, abs=1e-10), name
        assert (abs(expected) > 1e-5) == (name != "gps.height_variance" or not elevation), name
    reverse = jax.grad(lambda x: replay.evidence_per_scan(free(x)))(x)
    np.testing.assert_allclose(reverse, gradient, rtol=1e-9, atol=1e-12)


SCALE, SIGMA = 2.0, 0.2


def driven(wrong, rng):
    """Return the settings and the run of a drive of 200 m whose odometry is twice as wrong as it states.

    The back end runs with a scale and a sigma of the fixes that are ``wrong`` times the true ones.
    """
    overrides = [
        "config.backend.gps=true",
        "params.backend.odometry_rotation_sigma=1e-5",
        "params.backend.odometry_translation_sigma=1e-4",
        f"params.backend.odometry_scale={SCALE * wrong}",
        f"params.gps.min_variance={(SIGMA * wrong) ** 2}",
        f"params.gps.lever_arm={LEVER.tolist()}",
        "params.gps.spacing=2.0",
    ]
    settings = with_overrides(recipe_settings("default"), overrides)
    seconds = np.arange(200) / 10
    stamps = np.round(seconds * 1e9).astype(np.int64)
    truth = poses_at(seconds, turning=0.2)
    growth = [stated(0.01, rng) for _ in seconds]
    odometry = [truth[0]]
    for T_last_this, own in zip(np.linalg.inv(truth[:-1]) @ truth[1:], growth[1:], strict=True):
        error = SCALE * rng.multivariate_normal(np.zeros(6), own)
        step = jaxlie.SE3.exp(jnp.asarray(np.roll(error, 3))).as_matrix()
        odometry.append(odometry[-1] @ T_last_this @ np.asarray(step))
    antennas = to_enu(truth[:, :3, :3] @ LEVER + truth[:, :3, 3])
    fixes = antennas + SIGMA * rng.normal(size=antennas.shape)
    covariances = np.tile(1e-4 * np.eye(3), (len(fixes), 1, 1))
    back_end = BackEnd(settings, None, GpsGate(stamps, fixes, covariances, settings.values["gps"], True))
    sigmas = [
        settings.values["backend"][f"odometry_{name}"]
        for name in ("rotation_sigma", "translation_sigma", "scale")
    ]
    none = np.zeros((0, 3), np.float32)
    for k, own in enumerate(growth):
        covariance = odometry_covariance(own, *sigmas)
        back_end.add(Keyframe(k, int(stamps[k]), odometry[k], none, covariance, own))
    back_end.settle()
    found = back_end.correction()
    replayed = replayed_graph(found, stamps, np.array(odometry), True)
    fixes_used = int((np.asarray(replayed.graph.kind) == POSITION).sum())
    return settings, CorrectedRun((None,) * len(stamps), (), replayed, 0, fixes_used)


@pytest.mark.long
def test_it_finds_the_errors_of_odometry_and_receiver_without_truth():
    settings, replay = driven(4.0, np.random.default_rng(7))
    assert replay.fixes > 80
    free = free_of_back_end(settings, ["backend.odometry_scale", "gps.min_variance"], MARGINAL)
    seen = []

    def evaluate(x):
        value, gradient = corrected_gradient(replay, free, MARGINAL.objective, jnp.asarray(x))
        seen.append((value, x))
        return Evaluated.mean([200], [value], [gradient])

    first = np.asarray(free.first())
    lbfgsb(evaluate, first, Bounds(first - 7.0, first + 7.0), 30)
    best = min(seen, key=lambda one: one[0])[1]
    found = dict(zip(free.names, np.exp(best), strict=True))
    assert found["backend.odometry_scale"] == pytest.approx(SCALE, rel=0.3)
    assert np.sqrt(found["gps.min_variance"]) == pytest.approx(SIGMA, rel=0.15)

    sigma = np.sqrt(np.diag(covariance_by_curvature(lambda x: 200 * evaluate(x).gradient, best)))
    true = {"backend.odometry_scale": SCALE, "gps.min_variance": SIGMA**2}
    errors = best - np.log([true[name] for name in free.names])
    assert (np.abs(errors) < 3 * sigma).all()
    # 80 fixes and 200 steps cannot tell more, and a tenth of the truth would be seen
    assert ((sigma > 0.02) & (sigma < 0.5)).all()


class Recorded:
    """A recording's name, which is all that a run made beforehand needs."""

    name = "drive"

    def __len__(self):
        return 10


def test_a_graph_without_loops_and_fixes_is_refused(monkeypatch):
    replayed, *_ = chain(np.random.default_rng(1))
    alone = eqx.tree_at(lambda one: one.graph.kind, replayed, jnp.full(len(replayed.graph.kind), ODOMETRY))
    assert replayed.closed
    monkeypatch.setattr(corrected, "corrected_run", lambda *_: CorrectedRun((), (), alone, 0, 0))
    settings = with_overrides(recipe_settings("default"), ["config.backend.loops=true"])
    free = free_of_back_end(settings, ["loop.*"], MARGINAL)
    loss = CorrectedLoss(settings, free, MARGINAL.objective)
    with pytest.raises(LioJaxError, match="drive: no loop and no fix is in the graph"):
        loss(np.asarray(free.first()), [Recorded()])


@pytest.mark.parametrize("text", ["marginal+ate", "0.5*marginal"])
def test_it_stands_alone(text):
    settings = with_overrides(recipe_settings("default"), ["config.backend.loops=true"])
    with pytest.raises(UsageError, match="take marginal alone"):
        free_of_back_end(settings, ["loop.*"], objective_named(text))
