"""Open a page in a headless Chromium and tell what the browser said, built and asked for."""

import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here (Debian's package chromium): pages are not opened"
)

_QUIET = (
    "--headless",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--hide-scrollbars",
    "--enable-logging=stderr",
)


@dataclass(frozen=True)
class Opened:
    """What became of a page."""

    console: list[str]
    """Lines that the page caused on the browser's console."""
    document: str
    """The document as the browser built it."""
    requested: list[str]
    """Addresses that were asked of any network."""
    picture: Path


def opened(page: Path, folder: Path, width: int = 1200, height: int = 2000) -> Opened:
    """Open a page; ``folder`` takes the browser's files."""
    assert CHROMIUM is not None
    network, picture = folder / "network.json", folder / "picture.png"
    # Chromium's sandbox refuses to start for the superuser, whom containers usually run as
    unboxed = ["--no-sandbox"] if os.geteuid() == 0 else []
    common = [CHROMIUM, *_QUIET, *unboxed, f"--user-data-dir={folder / 'profile'}"]
    done = [
        subprocess.run(
            [*common, *options, f"--window-size={width},{height}", page.resolve().as_uri()],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        for options in (
            ["--dump-dom", f"--log-net-log={network}"],
            [f"--screenshot={picture}"],
        )
    ]
    console = [line for line in (done[0].stderr + done[1].stderr).splitlines() if ":CONSOLE" in line]
    return Opened(console, done[0].stdout, _network_addresses(network), picture)


def _network_addresses(log: Path) -> list[str]:
    """Return the http and https addresses in a network log, the browser's own errands left out."""
    events = json.loads(log.read_text())["events"]
    found = {str(event.get("params", {}).get("url", "")) for event in events}
    return sorted(url for url in found if url.startswith(("http:", "https:")) and "google" not in url)
