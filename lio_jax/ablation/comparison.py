"""An ablation's results put together: values by variant and case, ranked, with what failed."""

import math
from dataclasses import dataclass

from lio_jax.ablation.metric_names import METRICS, TIME
from lio_jax.ablation.ranking import SIGNIFICANT, Case, Ranked, ranking
from lio_jax.ablation.results import gathered
from lio_jax.ablation.spec import Spec
from lio_jax.ablation.store import Store
from lio_jax.ablation.tasks import Task

Values = dict[str, dict[str, dict[Case, float]]]


@dataclass(frozen=True)
class Comparison:
    """What a table and a report show."""

    spec: Spec
    tasks: list[Task]
    done: set[str]
    """Keys."""
    values: Values
    """Metric -> variant -> case -> value; the first metric ranks."""
    rows: list[Ranked]
    failures: dict[str, dict[str, str]]
    """Key -> record."""

    @property
    def metric(self) -> str:
        """Return the metric that ranks."""
        return self.spec.metrics[0]

    def __str__(self) -> str:
        """Return the ranking as an aligned table."""
        return as_text(self)


def compare(spec: Spec, tasks: list[Task], store: Store) -> Comparison:
    """Read the results and rank them."""
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
    return Comparison(spec, tasks, set(store.done(keys)), values, rows, failures)


def verdict(row: Ranked, baseline: str) -> str:
    """Return what the paired test says of a variant."""
    if row.variant == baseline:
        return "baseline"
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


def cells(row: Ranked, comparison: Comparison) -> list[str]:
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


def as_text(comparison: Comparison) -> str:
    """Return the ranking as an aligned table."""
    rows = [header(comparison.spec), *(cells(row, comparison) for row in comparison.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        first, *rest = zip(row, widths, strict=True)
        lines.append("  ".join([first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in rest)]))
    return "\n".join(line.rstrip() for line in lines)


def number(value: float, digits: int = 4) -> str:
    """Return a number as text, "-" where there is none."""
    return "-" if math.isnan(value) else f"{value:.{digits}g}"
