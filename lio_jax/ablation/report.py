"""The HTML report of an ablation."""

import base64
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from lio_jax.ablation.ranking import VariantComparison, cells, header, number
from lio_jax.ablation.spec import METRICS, TIME
from lio_jax.ablation.store import Store
from lio_jax.run.folder import write_text
from lio_jax.viz.html import CONTENT_POLICY
from lio_jax.viz.plot import letters_may_lack

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE = (5.2, 3.6)
_DARK, _LIGHT = "#1f5f8b", "#9db8cc"
_LABELLED = 12
"""Largest number of points with names: more names would cover each other."""


def parameter_picture(path: str, values: Mapping[Any, list[float]], error: str) -> str:
    """Draw the error over a parameter's values: every run, and the mean of each value.

    Args:
        path: path of the parameter.
        values: value of the parameter -> errors of all runs with that value.
        error: label of the error's axis.

    Returns:
        An SVG as a data URI.
    """
    figure, axes = _axes()
    numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    points = sorted(values) if numeric else list(values)
    places = np.array(points, float) if numeric else np.arange(len(points), dtype=float)
    for place, point in zip(places, points, strict=True):
        axes.plot([place] * len(values[point]), values[point], ".", color=_LIGHT, markersize=5)
    axes.plot(places, [np.mean(values[point]) for point in points], "o-" if numeric else "o", color=_DARK)
    if not numeric:
        axes.set_xticks(places, [_plain(str(point)) for point in points], rotation=20, ha="right")
    elif places.min() > 0 and places.max() / places.min() > 20:
        axes.set_xscale("log")
    everything = [value for found in values.values() for value in found]
    if min(everything) > 0 and max(everything) / min(everything) > 20:
        axes.set_yscale("log")
    axes.set_xlabel(_plain(path))
    axes.set_ylabel(_plain(error))
    return _uri(figure)


def pareto_picture(points: Mapping[str, tuple[float, float]], time: str, error: str) -> str:
    """Draw the variants by time and error, with the Pareto front, whose variants no other beats in both.

    Args:
        points: variant -> (time, error), finite.
        time: label of the time's axis.
        error: label of the error's axis.

    Returns:
        An SVG as a data URI.
    """
    figure, axes = _axes()
    front = pareto_front(points)
    for name, (x, y) in points.items():
        axes.plot(x, y, "o", color=_DARK if name in front else _LIGHT)
        if name in front or len(points) <= _LABELLED:
            axes.annotate(_plain(name), (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7)
    corners = np.array([points[name] for name in front])
    axes.step(corners[:, 0], corners[:, 1], where="post", color=_DARK, linewidth=1)
    axes.set_xlabel(_plain(time))
    axes.set_ylabel(_plain(error))
    return _uri(figure)


def pareto_front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the names that no other beats in both numbers, sorted by the first number."""
    front, best = [], math.inf
    for name in sorted(points, key=lambda name: points[name]):
        if points[name][1] < best:
            front.append(name)
            best = points[name][1]
    return front


def _axes() -> "tuple[Figure, Axes]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    return figure, axes


def _plain(text: str) -> str:
    """Return text in which matplotlib finds no mathematics."""
    return text.replace("$", r"\$")


def _uri(figure: "Figure") -> str:
    from matplotlib import rc_context

    buffer = io.BytesIO()
    # equal results give equal bytes
    with (
        rc_context({"svg.hashsalt": "lio_jax", "svg.fonttype": "none", "font.family": "sans-serif"}),
        letters_may_lack(),
    ):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()


_STYLE = """
:root{color-scheme:light}body{font:16px/1.5 system-ui,sans-serif;color:#222;background:#fff;margin:0 auto;
max-width:70rem;padding:1rem}h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}
.wide{overflow-x:auto}table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.9rem}
td,th{padding:.3rem .6rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}
td:first-child,th:first-child{text-align:left}td.text{text-align:left;white-space:normal}
.pictures{display:flex;flex-wrap:wrap;gap:1rem}img{max-width:100%;height:auto}
figure{margin:0}.soft{color:#666;font-size:.9rem}pre{overflow-x:auto;background:#f6f6f6;padding:.7rem}
"""


def write_report(comparison: VariantComparison, store: Store) -> None:
    """Write report.html into the ablation's folder."""
    write_text(store.root / "report.html", report(comparison, store))


def report(comparison: VariantComparison, store: Store) -> str:
    """Return the page as HTML."""
    spec = comparison.spec
    total = len(comparison.tasks)
    size = f"{len(spec.variants)} variants on {len(spec.sources)} recordings"
    parts = [
        f"<h1>{escape(spec.name)}</h1>",
        f"<p>{size}: {len(comparison.done)} of {total} runs done, {len(comparison.failures)} failed.</p>",
        "<h2>Ranking</h2>",
        _table(header(spec), [[escape(cell) for cell in cells(row, comparison)] for row in comparison.rows]),
        f'<p class="soft">{escape(_explained(comparison))}</p>',
        *_pictures(comparison),
        *_failures(comparison),
        "<h2>Runs</h2>",
        _runs(comparison, store),
        f"<details><summary>Specification</summary><pre>{escape(spec.text)}</pre></details>",
    ]
    head = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f'<link rel="icon" href="data:,">{CONTENT_POLICY}'
        f"<title>{escape(spec.name)}</title><style>{_STYLE}</style></head>"
    )
    return f"{head}<body>{''.join(parts)}</body></html>\n"


def _explained(comparison: VariantComparison) -> str:
    return (
        f"Means over recordings and seeds; ranked by {comparison.metric}, incomplete variants last. "
        "± seeds: standard deviation over seeds of the mean over recordings. vs baseline: geometric mean of "
        f"the ratio to '{comparison.spec.baseline.name}' on the same recording and seed. p (t): two-sided "
        "paired t-test of the logarithms (of the values where some are not positive); p (ranks): Wilcoxon's "
        "signed-rank test on the same pairs, from six on. The verdict takes p (t), corrected by Holm for "
        "the number of variants, below 0.05. Times are those of parallel runs on one machine."
    )


def _pictures(comparison: VariantComparison) -> Iterable[str]:
    by_variant = comparison.values[comparison.metric]
    label = _labelled(comparison.metric)
    if not by_variant:
        return
    drawn = []
    means = {name: (name, errors) for name, errors in by_variant.items()}
    times = comparison.values[TIME]
    points = {
        name: (float(np.mean([*times[name].values()])), float(np.mean([*errors.values()])))
        for name, errors in means.values()
        if times.get(name) and len(errors) == len(comparison.spec.sources)
    }
    if points and comparison.metric != TIME:
        drawn.append(("Error against time", pareto_picture(points, _labelled(TIME), label)))
    for path in dict.fromkeys(path for variant in comparison.spec.variants for path in variant.overrides):
        found: dict[Any, list[float]] = {}
        for variant in comparison.spec.variants:
            if path in variant.overrides and variant.name in by_variant:
                value = variant.overrides[path]
                key = value if isinstance(value, int | float | str) else json.dumps(value)
                found.setdefault(key, []).extend(by_variant[variant.name].values())
        if len(found) > 1:
            drawn.append((path, parameter_picture(path, found, label)))
    if drawn:
        yield '<h2>Pictures</h2><div class="pictures">'
        for title, uri in drawn:
            yield f'<figure><img alt="{escape(title)}" src="{uri}"></figure>'
        yield "</div>"


def _failures(comparison: VariantComparison) -> Iterable[str]:
    if not comparison.failures:
        return
    yield "<h2>Failed</h2>"
    rows = [
        [escape(record["run"]), f"{escape(record['reason'])}{_folded(record['traceback'])}"]
        for record in comparison.failures.values()
    ]
    yield _table(["run", "reason"], rows, text=True)


def _folded(trace: str) -> str:
    return f"<details><summary>traceback</summary><pre>{escape(trace)}</pre></details>" if trace else ""


def _runs(comparison: VariantComparison, store: Store) -> str:
    metrics = comparison.spec.metrics
    rows = []
    for task in comparison.tasks:
        if task.key not in comparison.done:
            continue
        own = store.folder(task.key) / "report.html"
        target = f"tasks/{quote(task.key)}/" + ("report.html" if own.exists() else "")
        case = (task.source.name, task.source.seed)
        values = [comparison.values[metric].get(task.variant.name, {}).get(case) for metric in metrics]
        rows.append(
            [
                f'<a href="{target}">{escape(task.source.name)}</a>',
                "-" if task.source.seed is None else str(task.source.seed),
                escape(task.variant.name),
                *("-" if value is None else number(value) for value in values),
            ]
        )
    return _table(["sequence", "seed", "variant", *map(_labelled, metrics)], rows)


def _table(names: Sequence[str], rows: Iterable[Sequence[str]], text: bool = False) -> str:
    """Return a table; names are escaped here, cells must be escaped already."""
    kind = '<td class="text">' if text else "<td>"
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"{kind}{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _labelled(metric: str) -> str:
    return f"{metric} [{METRICS[metric]}]" if METRICS[metric] else metric
