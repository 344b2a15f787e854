"""Compare the results of an ablation's runs, and rank its variants with paired tests."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ttest_rel, wilcoxon

from lio_jax.ablation.spec import METRICS, TIME, Spec
from lio_jax.ablation.store import Store, gathered
from lio_jax.ablation.tasks import Task

Case = tuple[str, int | None]
"""A recording and its seed."""

SIGNIFICANT = 0.05
_FEWEST_FOR_RANKS = 6
"""Fewest pairs for the signed-rank test: with fewer its p cannot fall below 0.05 for any values."""
_NO_DIFFERENCE = 1e-12


@dataclass(frozen=True)
class Ranked:
    """One variant's row of the ranking."""

    variant: str
    cases: int
    """Number of pairs of recording and seed for which the variant has a value."""
    means: dict[str, float]
    """Mean of each metric over the variant's own cases; NaN without any."""
    spread: float
    """Standard deviation over seeds of the first metric's mean over recordings; NaN with fewer than two."""
    ratio: float
    """Geometric mean of value / baseline of the first metric, over the cases of both.

    NaN without common cases, or if some values are not positive.
    """
    pairs: int
    """Number of cases for which both the variant and the baseline have a value."""
    p_t: float
    """Two-sided p of the paired t-test (of logarithms if all values are positive); NaN below two pairs."""
    p_ranks: float
    """Two-sided p of Wilcoxon's signed-rank test on these pairs; NaN with fewer than six pairs."""
    p_adjusted: float
    """p_t after Holm's correction for the number of variants."""


def ranking(
    values: Mapping[str, Mapping[str, Mapping[Case, float]]],
    variants: Sequence[str],
    baseline: str,
    cases: int,
) -> list[Ranked]:
    """Rank variants by the mean of the first metric; incomplete variants come after complete ones.

    Recordings differ in difficulty, so variants are compared case by case: a ratio of 0.9 is an error 10 %
    smaller than the baseline's on the same recording and seed. A p below 0.05 in one of many comparisons is
    weak evidence, hence Holm's correction (Holm, "A simple sequentially rejective multiple test procedure",
    1979).

    Args:
        values: metric -> variant -> case -> value; the first metric ranks.
        variants: names of all variants.
        baseline: the variant with which the others are compared.
        cases: the full number of cases.
    """
    first = next(iter(values))
    of_baseline = values[first].get(baseline, {})
    rows = []
    for variant in variants:
        own = values[first].get(variant, {})
        common = [case for case in own if case in of_baseline] if variant != baseline else []
        ours = np.array([own[case] for case in common])
        theirs = np.array([of_baseline[case] for case in common])
        ratio, p_t, p_ranks = _compared(ours, theirs)
        rows.append(
            Ranked(
                variant,
                len(own),
                {metric: _mean(list(by.get(variant, {}).values())) for metric, by in values.items()},
                _spread(own),
                ratio,
                len(common),
                p_t,
                p_ranks,
                float("nan"),
            )
        )
    adjusted = holm([row.p_t for row in rows])
    rows = [Ranked(**{**vars(row), "p_adjusted": p}) for row, p in zip(rows, adjusted, strict=True)]
    return sorted(rows, key=lambda row: (row.cases < cases, -row.cases, _last(row.means[first])))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values corrected for their number; NaN stays NaN and is not counted."""
    order = sorted((p, place) for place, p in enumerate(p_values) if not np.isnan(p))
    corrected, largest = [float("nan")] * len(p_values), 0.0
    for rank, (p, place) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        corrected[place] = largest
    return corrected


def _compared(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> tuple[float, float, float]:
    nothing = float("nan")
    if not len(ours):
        return nothing, nothing, nothing
    positive = bool((ours > 0).all() and (theirs > 0).all())
    a, b = (np.log(ours), np.log(theirs)) if positive else (ours, theirs)
    ratio = float(np.exp(np.mean(a - b))) if positive else nothing
    if (np.abs(a - b) < _NO_DIFFERENCE).all():
        return ratio, nothing, nothing
    p_t = float(ttest_rel(a, b).pvalue) if len(a) > 1 and np.ptp(a - b) > _NO_DIFFERENCE else nothing
    p_ranks = float(wilcoxon(a, b).pvalue) if len(a) >= _FEWEST_FOR_RANKS else nothing
    return ratio, p_t, p_ranks


def _spread(own: Mapping[Case, float]) -> float:
    by_seed: dict[int, list[float]] = {}
    for (_, seed), value in own.items():
        if seed is not None:
            by_seed.setdefault(seed, []).append(value)
    # a seed without one of the recordings would differ because of the recording, not by chance
    whole = max(map(len, by_seed.values()), default=0)
    means = [float(np.mean(values)) for values in by_seed.values() if len(values) == whole]
    return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def _last(value: float) -> float:
    return float("inf") if np.isnan(value) else value


Values = dict[str, dict[str, dict[Case, float]]]


@dataclass(frozen=True)
class VariantComparison:
    """All that a table and a report show."""

    spec: Spec
    tasks: list[Task]
    done: set[str]
    """Keys of the finished tasks."""
    values: Values
    """Metric -> variant -> case -> value; the first metric ranks."""
    rows: list[Ranked]
    failures: dict[str, dict[str, str]]
    """Records of the failed tasks by key."""

    @property
    def metric(self) -> str:
        """Return the metric by which variants are ranked."""
        return self.spec.metrics[0]

    def __str__(self) -> str:
        """Return the ranking as an aligned table."""
        return as_text(self)


def compare(spec: Spec, tasks: list[Task], store: Store) -> VariantComparison:
    """Read the results of all runs and rank them."""
    columns = list(dict.fromkeys((*spec.metrics, TIME)))
    table = gathered(store, tasks, columns)
    values: Values = {metric: {} for metric in columns}
    for row in table.to_pylist():
        case = (row["sequence"], row["seed"])
        for metric in columns:
            value = row.get(metric)
            if value is not None and math.isfinite(value):
                values[metric].setdefault(row["variant"], {})[case] = value
    rows = ranking(values, [variant.name for variant in spec.variants], spec.baseline.name, len(spec.sources))
    keys = [task.key for task in tasks]
    failures = {key: store.reason(key) for key in store.failed(keys)}
    return VariantComparison(spec, tasks, set(store.done(keys)), values, rows, failures)


def verdict(row: Ranked, baseline: str) -> str:
    """Return the result of the paired test for a variant, in words."""
    if row.variant == baseline:
        return "baseline"
    if not row.cases:
        return "no value"
    if math.isnan(row.p_adjusted):
        return "too few pairs" if row.pairs < 2 else "no difference"
    if row.p_adjusted >= SIGNIFICANT:
        return "may be chance"
    return "better" if row.ratio < 1 else "worse" if row.ratio > 1 else "differs"


def header(spec: Spec) -> list[str]:
    """Return the names of the ranking's columns."""
    units = {metric: f" [{METRICS[metric]}]" if METRICS[metric] else "" for metric in spec.metrics}
    first, *others = [metric + units[metric] for metric in spec.metrics]
    return ["variant", "runs", first, "± seeds", "vs baseline", "p (t)", "p (ranks)", "verdict", *others]


def cells(row: Ranked, comparison: VariantComparison) -> list[str]:
    """Return a variant's row of the ranking as text."""
    first, *others = comparison.spec.metrics
    baseline = comparison.spec.baseline.name
    return [
        row.variant,
        f"{row.cases}/{len(comparison.spec.sources)}",
        number(row.means[first]),
        number(row.spread),
        "-" if math.isnan(row.ratio) else f"x {row.ratio:.3g}",
        number(row.p_t, 2),
        number(row.p_ranks, 2),
        verdict(row, baseline),
        *(number(row.means[metric]) for metric in others),
    ]


def as_text(comparison: VariantComparison) -> str:
    """Return the ranking as an aligned table."""
    rows = [header(comparison.spec), *(cells(row, comparison) for row in comparison.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        first, *rest = zip(row, widths, strict=True)
        lines.append("  ".join([first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in rest)]))
    if comparison.done and not any(row.cases for row in comparison.rows):
        lines.append(
            f"No run has a value of {comparison.metric}. Errors of the trajectory need the true one: give it "
            "by the key truth of the recording, or rank by another metric, such as failed_scans."
        )
    return "\n".join(line.rstrip() for line in lines)


def number(value: float, digits: int = 4) -> str:
    """Return a number as text; return "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:.{digits}g}"
