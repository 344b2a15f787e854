"""Optimisers and the session around them, on losses whose minimum is known."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.tuning.gradient import Evaluated
from lio_jax.tuning.objectives import objective_named
from lio_jax.tuning.optimise import (
    Bounds,
    adam,
    fisher_information,
    fisher_scoring,
    lbfgsb,
    parameter_covariance,
    stationary,
)
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.session import HISTORY, Session
from lio_jax.tuning.tune import tuned_by
from tests.params import default_params

WIDE = Bounds(np.full(2, -20.0), np.full(2, 20.0))
SAMPLES = np.random.default_rng(0).normal(0.0, [0.02, 3.0], (4000, 2))


class Drive:
    """Stands for a recording."""

    def __init__(self, name="drive"):
        self.name = name

    def __len__(self):
        return len(SAMPLES)


def problem(loss, scored=True, **changed):
    """Return what a session sees of a problem with one recording."""
    seen = {
        "free": free_parameters(default_params(), ["imu.gyro_noise", "lidar.range_sigma"]),
        "loss": loss,
        "named": objective_named("noise"),
        "settings": SimpleNamespace(recipe="default", config=1, values={}),
        "training": (Drive(),),
        "validation": (),
        "scored": scored,
    }
    return SimpleNamespace(**{**seen, **changed})


def noise_likelihood(x):
    """Return the mean negative log-likelihood of zero-mean samples, x their log standard deviations."""
    square = SAMPLES**2 * np.exp(-2 * np.asarray(x))
    value = float(np.mean(np.sum(square / 2 + x, 1)))
    scores = 1 - square
    return Evaluated(value, scores.mean(0), scores, 0, len(SAMPLES))


def visits(optimiser, *arguments, **named):
    seen = []

    def evaluate(x):
        seen.append(np.array(x))
        return noise_likelihood(x)

    optimiser(evaluate, *arguments, **named)
    return seen


BEST = np.log(np.sqrt(np.mean(SAMPLES**2, 0)))


OPTIMISERS = [fisher_scoring, lbfgsb, stationary]


@pytest.mark.parametrize("factor", [10.0, 0.1], ids=["too large", "too small"])
@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=lambda f: f.__name__)
def test_ten_times_wrong_densities_are_found(optimiser, factor):
    reached = visits(optimiser, BEST + np.log(factor), WIDE, 60)
    values = [noise_likelihood(x).value for x in reached]
    np.testing.assert_allclose(reached[int(np.argmin(values))], BEST, atol=0.02)


@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=lambda f: f.__name__)
def test_bounds_hold(optimiser):
    bounds = Bounds(BEST + 0.5, BEST + 3.0)
    reached = visits(optimiser, BEST + 2.0, bounds, 60)
    assert all(np.all((x >= bounds.lower - 1e-12) & (x <= bounds.upper + 1e-12)) for x in reached)
    np.testing.assert_allclose(reached[-1], bounds.lower, atol=0.01)


def test_a_loss_that_jumps_is_minimised_by_its_gradient():
    """A valley that is ten times as steep one way as the other, with steps as of choices that flip."""
    random = np.random.default_rng(5)
    basis = np.linalg.qr(random.normal(size=(20, 20)))[0]
    curvature = basis @ np.diag(np.geomspace(1.0, 10.0, 20)) @ basis.T
    lowest, reached = random.normal(size=20) * 0.5, []

    def evaluate(x):
        reached.append(np.array(x))
        away = x - lowest
        jump = 0.2 * float(np.sum(np.floor(50 * x) % 2))
        return Evaluated(away @ curvature @ away / 2 + jump, curvature @ away, None, 0, 1)

    stationary(evaluate, np.zeros(20), Bounds(np.full(20, -7.0), np.full(20, 7.0)), 60)
    assert len(reached) < 40
    np.testing.assert_allclose(reached[-1], lowest, atol=0.02)


def test_stochastic_steps_find_the_minimum():
    random = np.random.default_rng(1)
    reached = []

    def segments():
        while True:
            rows = random.integers(len(SAMPLES), size=200)

            def evaluate(x, rows=rows):
                reached.append(np.array(x))
                scores = 1 - SAMPLES[rows] ** 2 * np.exp(-2 * x)
                return Evaluated(0.0, scores.mean(0), scores, 0, len(rows))

            yield evaluate

    adam(segments(), BEST + np.log(3.0), WIDE, 150)
    np.testing.assert_allclose(reached[-1], BEST, atol=0.05)


def test_the_fisher_information_gives_the_standard_deviation():
    sigma = np.sqrt(np.diag(np.linalg.inv(fisher_information(noise_likelihood(BEST)))))
    np.testing.assert_allclose(sigma, 1 / np.sqrt(2 * len(SAMPLES)), rtol=0.1)
    drawn = multivariate_normal(np.zeros(2), np.diag(np.exp(2 * BEST))).rvs(
        (300, 200), np.random.default_rng(2)
    )
    spread = np.std(np.log(np.sqrt(np.mean(drawn**2, 1))), 0)
    np.testing.assert_allclose(sigma * np.sqrt(len(SAMPLES) / 200), spread, rtol=0.15)


@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.9])
def test_intervals_hold_the_truth_where_scans_are_correlated(correlation):
    """The mean of an AR(1) process of variance 4: intervals from its scores, in 400 draws of 400 scans."""
    random, held, held_if_independent = np.random.default_rng(7), 0, 0
    for _ in range(400):
        noise = random.normal(size=(500, 1)) * np.sqrt(1 - correlation**2)
        for place in range(1, len(noise)):
            noise[place] += correlation * noise[place - 1]
        scores = noise[100:] / 2.0
        result = Evaluated(0.0, scores.mean(0), scores, 0, 400)
        # the maximum of the likelihood lies off the truth by the mean of the scores over the curvature
        error = float(scores.sum()) * 4.0 / 400
        held += abs(error) < 1.96 * float(parameter_covariance(result)[0, 0]) ** 0.5
        held_if_independent += (
            abs(error) < 1.96 * float(np.linalg.inv(fisher_information(result))[0, 0]) ** 0.5
        )
    assert held >= 0.85 * 400
    if correlation:
        assert held_if_independent < 0.75 * 400


def test_the_covariance_of_independent_scores_is_the_inverse_information():
    result = noise_likelihood(BEST)
    covariance = parameter_covariance(result)
    np.testing.assert_allclose(
        np.diag(covariance), np.diag(np.linalg.inv(fisher_information(result))), rtol=0.1
    )
    silent = np.insert(result.scores, [100, 2000], 0.0, axis=0)
    with_lost_scans = Evaluated(0.0, silent.mean(0), silent, 0, len(silent))
    np.testing.assert_allclose(parameter_covariance(with_lost_scans), covariance, rtol=1e-12)


def test_a_parameter_without_effect_leaves_the_information_regular():
    scores = np.random.default_rng(3).normal(size=(50, 2)) * [1.0, 0.0]
    result = Evaluated(0.0, scores.mean(0), scores, 0, 50)
    assert np.isfinite(np.linalg.inv(fisher_information(result))).all()
    covariance = parameter_covariance(result)
    assert covariance[1, 1] == pytest.approx(1.0)
    assert np.isfinite(covariance).all()


FREE = free_parameters(default_params(), ["imu.gyro_noise", "lidar.range_sigma"])


def test_the_best_of_a_session_that_looks_for_the_zero_has_the_smallest_gradient(tmp_path):
    def loss(x, recordings):
        fair = noise_likelihood(x)
        # jumps by more than the loss has left to fall
        value = fair.value + 0.3 * (np.floor(20 * x[0]) % 2)
        return Evaluated(value, fair.gradient, None, 0, len(SAMPLES))

    tuning = Session(problem(loss, scored=False), tmp_path, 50)
    tuning.run("stationary", BEST + 2.0, WIDE, 40, 0)
    np.testing.assert_allclose(tuning.best.x, BEST, atol=0.02)


@pytest.mark.parametrize(
    "free", [["imu.gyro_noise", "lidar.range_sigma"], ["imu.*_noise", "lidar.range_sigma"]]
)
def test_the_likelihood_of_a_graph_has_intervals_by_its_curvature(tmp_path, free):
    """Standard deviations of N normal samples have a relative error of 1 / sqrt(2 N) each.

    A further parameter on which the likelihood does not depend gets an interval over all magnitudes.
    """
    free = free_parameters(default_params(), free)
    known = [free.names.index(name) for name in ("imu.gyro_noise", "lidar.range_sigma")]

    def loss(x, recordings):
        fair, gradient = noise_likelihood(x[known]), np.zeros(len(x))
        gradient[known] = fair.gradient
        return Evaluated(fair.value, gradient, None, 0, len(SAMPLES))

    graph = problem(loss, scored=False, of_graph=True, free=free)
    graph.tuned_settings, graph.at_limit = lambda x: None, lambda x: ()
    tuning, first = Session(graph, tmp_path, 50), np.zeros(len(free.names))
    first[known] = BEST + 1.0
    tuning.run("lbfgsb", first, Bounds(first - 9.0, first + 9.0), 40, 0)
    found = tuned_by(graph, tuning)
    for name, (low, high) in found.intervals.items():
        if name == "imu.accel_noise":
            assert high / low > 1e6
        else:
            assert np.log(high / low) == pytest.approx(2 * 1.96 / np.sqrt(2 * len(SAMPLES)), rel=1e-3)
            assert low < found.values[name] < high


def session(folder, loss=None, patience=50, observer=lambda iterate: None):
    evaluate = loss or (lambda x, recordings: noise_likelihood(x))
    return Session(problem(evaluate), folder, patience, observer)


def test_a_killed_tuning_goes_on_from_its_last_iterate(tmp_path):
    class Killed(Exception):
        pass

    def kill(iterate):
        if len(first.history) == 3:
            raise Killed

    first = session(tmp_path, observer=kill)
    with pytest.raises(Killed):
        first.run("scoring", BEST + 1.5, WIDE, 30, 0)
    held = json.loads((tmp_path / HISTORY).read_text())
    assert held["identity"]["parameters"] == list(FREE.names)
    assert len(held["iterates"]) == 3

    second = session(tmp_path)
    assert second.history == first.history
    second.run("scoring", BEST + 1.5, WIDE, 30, 0)
    np.testing.assert_array_equal(second.history[3].x, first.history[2].x)
    np.testing.assert_allclose(second.best.x, BEST, atol=0.02)
    assert len(second.history) <= 30


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"free": free_parameters(default_params(), ["imu.accel_noise"])}, "parameters"),
        ({"named": objective_named("ate")}, r"objective \(it has pose\+ranges\)"),
        ({"training": (Drive("other"),)}, "recordings"),
    ],
)
def test_the_history_of_another_tuning_is_refused(tmp_path, changed, named):
    session(tmp_path).run("scoring", BEST + 1.5, WIDE, 1, 0)
    with pytest.raises(
        UsageError, match=rf"{HISTORY}: is the history of another problem, with other {named}; .*--overwrite"
    ):
        Session(problem(lambda x, recordings: noise_likelihood(x), **changed), tmp_path, 50)


def test_the_history_of_another_tuning_is_refused_before_the_rest_is_read(tmp_path):
    session(tmp_path).run("scoring", BEST + 1.5, WIDE, 1, 0)
    held = json.loads((tmp_path / HISTORY).read_text())
    (tmp_path / HISTORY).write_text(json.dumps(held | {"iterates": [{"of another version": 1}]}))
    with pytest.raises(LioJaxError, match="is no history that can be continued"):
        session(tmp_path)
    other = problem(lambda x, recordings: noise_likelihood(x), training=(Drive("other"),))
    with pytest.raises(UsageError, match="is the history of another problem, with other recordings"):
        Session(other, tmp_path, 50)


@pytest.mark.parametrize("written", ["", "[]", '{"names": []}', '{"identity": {}, "iterates": []}'])
def test_a_history_that_cannot_be_read_is_named(tmp_path, written):
    (tmp_path / HISTORY).write_text(written)
    with pytest.raises(LioJaxError, match=rf"{HISTORY}: is no history that can be continued"):
        session(tmp_path)


def test_it_stops_when_nothing_gets_better(tmp_path):
    def rising(x, recordings):
        result = noise_likelihood(x)
        return Evaluated(float(len(tuning.history)), result.gradient, result.scores, 0, len(SAMPLES))

    tuning = session(tmp_path, rising, patience=4)
    tuning.run("scoring", BEST + 5.0, WIDE, 30, 0)
    assert len(tuning.history) == 5
    assert tuning.best == tuning.history[0]


def test_a_start_that_is_not_finite_is_refused(tmp_path):
    def broken(x, recordings):
        result = noise_likelihood(x)
        return Evaluated(float("nan"), result.gradient, result.scores, 0, 10)

    with pytest.raises(LioJaxError, match="not finite at the start"):
        session(tmp_path, broken).run("scoring", BEST, WIDE, 5, 0)


def test_a_recording_of_which_no_scan_counts_is_refused(tmp_path):
    def silent(x, recordings):
        return Evaluated(0.0, np.zeros(2), np.zeros((10, 2)), 0, 10)

    with pytest.raises(LioJaxError, match="none of the 10 scans tells of the parameters"):
        session(tmp_path, silent).run("scoring", BEST, WIDE, 5, 0)


def test_the_information_is_the_scatter_of_the_scores_of_scans_that_count():
    scores = np.random.default_rng(6).normal([3.0, -1.0], [0.5, 2.0], (200, 2))
    silent = np.concatenate([np.zeros((10, 2)), scores])
    result = Evaluated(0.0, silent.mean(0), silent, 0, len(silent))
    expected = np.cov(scores.T, bias=True) * len(scores)
    np.testing.assert_allclose(fisher_information(result), expected, rtol=1e-6)
