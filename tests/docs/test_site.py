"""The site builds without a warning, its links lead somewhere, and a narrow browser shows each page."""

import os
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import lio_jax
from tests.viz.browser import needs_browser, visited

ROOT = Path(__file__).parents[2]
PHONE = 390
"""Width of a phone's window, pixels."""

pytestmark = pytest.mark.skipif(
    find_spec("mkdocs") is None,
    reason="mkdocs is not installed here (extra docs of this package): the site is not built",
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, "Page"]:
    """Return the site's pages as they were parsed."""
    # 404.html is served for any missing page, so that its links are absolute
    return {path: Page(path) for path in sorted(site.rglob("*.html")) if path.name != "404.html"}


class Page(HTMLParser):
    """Targets and addresses of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.headings = 0
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.headings += tag == "h1"
        self.anchors |= {value for key in ("id", "name") if (value := given.get(key))}
        if tag != "link" or given.get("rel") in ("stylesheet", "icon"):
            self.links += [value for key in ("href", "src") if (value := given.get(key))]


def internal(page: Page) -> Iterator[tuple[str, str]]:
    """Yield path and fragment of each link that stays within the site."""
    for link in page.links:
        parts = urlsplit(link)
        if not parts.scheme and not parts.netloc:
            yield unquote(parts.path), unquote(parts.fragment)


def test_every_page_has_one_title(pages):
    assert len(pages) > 30
    assert [path.name for path, page in pages.items() if page.headings != 1] == []


def test_no_link_or_anchor_is_broken(pages):
    broken = []
    for path, page in pages.items():
        for target, fragment in internal(page):
            file = (path.parent / target).resolve() if target else path
            file = file / "index.html" if file.is_dir() else file
            known = pages[file].anchors if file in pages else None
            # the theme's own script makes these anchors
            if not file.is_file() or (
                fragment and known is not None and fragment not in known and not fragment.startswith("__")
            ):
                broken.append(f"{path.name}: {target}#{fragment}")
    assert broken == []


def test_every_public_name_has_its_place(pages):
    text = next(page for path, page in pages.items() if path.name == "api.html")
    missing = [name for name in lio_jax.__all__ if not any(_ends(anchor, name) for anchor in text.anchors)]
    assert missing == []


def _ends(anchor: str, name: str) -> bool:
    return anchor.startswith("lio_jax.") and anchor.rpartition(".")[2] == name


@needs_browser
def test_a_phone_shows_each_page_without_scrolling_sideways(site, pages, tmp_path):
    names = {path.as_uri(): str(path.relative_to(site)) for path in pages}
    found = {names[address]: page for address, page in visited(list(names), tmp_path, PHONE, 120.0).items()}
    assert set(found) == set(names.values())
    assert {name: page.width for name, page in found.items() if page.width > PHONE} == {}
    assert {name: page.complaints for name, page in found.items() if page.complaints} == {}
    assert {name: page.foreign for name, page in found.items() if page.foreign} == {}
