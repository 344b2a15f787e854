"""The ranking and its tests against scipy, by hand, and with little data."""

import math

import numpy as np
import pytest
from scipy.stats import ttest_1samp, wilcoxon

from lio_jax.ablation.ranking import VariantComparison, holm, ranking
from lio_jax.ablation.report import pareto_front
from lio_jax.ablation.spec import load_spec
from lio_jax.ablation.tasks import tasks_of
from tests.ablation.drives import write_spec

SEEDS = range(5)
WORLDS = ("a", "b")


def cases(function):
    return {(world, seed): function(world, seed) for world in WORLDS for seed in SEEDS}


def base(world, seed):
    return (10.0 if world == "b" else 1.0) + 0.1 * seed


def rank(by_variant, **more):
    values = {"ate.rmse": by_variant, **more}
    rows = ranking(values, list(by_variant), "base", len(WORLDS) * len(SEEDS))
    return rows, {row.variant: row for row in rows}


def test_paired_tests_on_ratios():
    draw = np.random.default_rng(0)
    ratios = np.exp(draw.normal(-0.2, 0.1, 10))
    theirs = cases(base)
    ours = {case: value * ratio for (case, value), ratio in zip(theirs.items(), ratios, strict=True)}
    rows, by_name = rank({"base": theirs, "ours": ours})
    row = by_name["ours"]
    assert [entry.variant for entry in rows] == ["ours", "base"]
    assert row.ratio == pytest.approx(np.exp(np.mean(np.log(ratios))))
    assert row.p_t == pytest.approx(ttest_1samp(np.log(ratios), 0.0).pvalue)
    assert row.p_ranks == pytest.approx(wilcoxon(np.log(ratios)).pvalue)
    assert row.p_adjusted == row.p_t < 0.05
    assert row.means["ate.rmse"] == pytest.approx(np.mean([*ours.values()]))
    assert math.isnan(by_name["base"].p_t)


def test_spread_is_over_seeds_not_over_worlds():
    _, by_name = rank({"base": cases(base)})
    by_seed = [np.mean([base(world, seed) for world in WORLDS]) for seed in SEEDS]
    assert by_name["base"].spread == pytest.approx(np.std(by_seed, ddof=1))


def test_who_lacks_the_hard_cases_does_not_win():
    easy = {case: 0.1 * value for case, value in cases(base).items() if case[0] == "a"}
    rows, by_name = rank({"base": cases(base), "easy": easy, "none": {}})
    assert [row.variant for row in rows] == ["base", "easy", "none"]
    assert by_name["easy"].pairs == 5
    assert by_name["easy"].ratio == pytest.approx(0.1)
    assert by_name["none"].cases == 0


def test_identical_results_are_no_difference():
    _, by_name = rank({"base": cases(base), "same": cases(base)})
    assert by_name["same"].ratio == 1.0
    assert math.isnan(by_name["same"].p_t)


def test_zeros_are_compared_by_difference():
    _, by_name = rank({"base": cases(lambda w, s: s % 3), "more": cases(lambda w, s: s % 3 + 1 + 0.1 * s)})
    assert math.isnan(by_name["more"].ratio)
    assert by_name["more"].p_t < 0.05


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, math.nan]) == pytest.approx([0.03, 0.06, 0.06, math.nan], nan_ok=True)
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_pareto_front():
    points = {"slow": (3.0, 1.0), "fast": (1.0, 3.0), "middle": (2.0, 2.0), "beaten": (2.5, 2.5)}
    assert pareto_front(points) == ["fast", "middle", "slow"]


def test_recordings_without_truth_are_named(tmp_path):
    spec = load_spec(write_spec(tmp_path / "spec.yaml"))
    tasks, names = tasks_of(spec), [variant.name for variant in spec.variants]
    values = {metric: {} for metric in spec.metrics}
    rows = ranking(values, names, spec.baseline.name, len(spec.sources))
    done = {task.key for task in tasks}
    *_, row, sentence = str(VariantComparison(spec, tasks, done, values, rows, {})).splitlines()
    assert "no value" in row
    assert sentence.startswith("No run has a value of ate.rmse. Errors of the trajectory need the true one")
