"""The page of an ablation: names are text, and the browser may run and load nothing."""

import pytest

from lio_jax.ablation.ranking import VariantComparison, ranking
from lio_jax.ablation.report import write_report
from lio_jax.ablation.spec import load_spec
from lio_jax.ablation.store import opened
from lio_jax.ablation.tasks import tasks_of
from tests.ablation.drives import DRIVE, write_spec
from tests.viz.browser import needs_browser
from tests.viz.browser import opened as opened_in_browser
from tests.viz.test_html import EVIL, Outline

NAME = EVIL + r" $\frac{ 测"
"""A name that would be an element of a page or a formula of a picture, with a letter that fonts lack."""


@pytest.fixture
def page(tmp_path):
    """Return the page of two runs that ended and one that failed."""
    spec = load_spec(
        write_spec(
            tmp_path / "spec.yaml",
            name=NAME,
            grid=None,
            list=[{"name": NAME, "params.map.voxel_size": 0.8}, {"params.map.voxel_size": 1.2}],
            sequences=[DRIVE, {"path": NAME}],
        )
    )
    tasks = tasks_of(spec)
    with opened(tmp_path / "out") as store:
        done = {task.key for task in tasks if task.source.name != NAME}
        values = {
            metric: {
                variant.name: {(task.source.name, task.source.seed): 1.0 + number}
                for number, variant in enumerate(spec.variants)
                for task in tasks
                if task.key in done
            }
            for metric in (*spec.metrics, "scan_ms.total.median")
        }
        failures = {
            task.key: {"run": NAME, "reason": NAME, "traceback": NAME}
            for task in tasks
            if task.key not in done
        }
        for key in done:
            store.folder(key).mkdir(parents=True)
        rows = ranking(values, [one.name for one in spec.variants], spec.baseline.name, len(spec.sources))
        write_report(VariantComparison(spec, tasks, done, values, rows, failures), store)
    return tmp_path / "out" / "report.html"


def test_names_are_text(page):
    outline = Outline(page.read_text())
    assert "script" not in outline.tags
    assert sum(NAME in words for words in outline.words) >= 6
    assert "default-src 'none'" in page.read_text()
    assert outline.tags.count("img") >= 1


@needs_browser
def test_a_browser_shows_the_page_and_asks_for_nothing(page, tmp_path):
    seen = opened_in_browser(page, tmp_path)
    assert seen.console == []
    assert seen.requested == []
