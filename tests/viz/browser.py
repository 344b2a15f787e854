"""Open a page in a headless Chromium and return its messages, elements, requests and picture."""

import asyncio
import base64
import io
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from tornado.websocket import websocket_connect

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
    """A page after it was opened."""

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


_SOFTWARE_GRAPHICS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_LOOK_EVERY_S = 2.0


def seen(address: str, folder: Path, enough: Callable[[np.ndarray], bool], seconds: float) -> np.ndarray:
    """Return what a page shows, (height, width, 3) of 0 to 1, as soon as it is enough or time is up.

    Args:
        address: of the page; it may draw by WebGL and take its time.
        folder: takes the browser's files.
        enough: tells of a picture whether the page is drawn.
        seconds: to wait at most.
    """
    assert CHROMIUM is not None
    profile = folder / "profile"
    unboxed = ["--no-sandbox"] if os.geteuid() == 0 else []
    options = [*_SOFTWARE_GRAPHICS, "--headless=new", "--no-first-run", "--hide-scrollbars", *unboxed]
    browser = subprocess.Popen(
        [
            *[CHROMIUM, *options, f"--user-data-dir={profile}"],
            *["--window-size=1200,800", "--remote-debugging-port=0", address],
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        return asyncio.run(_watched(profile / "DevToolsActivePort", enough, time.monotonic() + seconds))
    finally:
        browser.kill()
        browser.wait()


async def _watched(port_file: Path, enough: Callable[[np.ndarray], bool], until: float) -> np.ndarray:
    """Take pictures by the DevTools protocol."""
    targets: list[dict[str, str]] = []
    while not any(target["type"] == "page" for target in targets):
        assert time.monotonic() < until, "the browser does not open the page"
        await asyncio.sleep(0.2)
        if port_file.exists() and (lines := port_file.read_text().split()):
            with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json", timeout=10) as reply:
                targets = json.load(reply)
    page = next(target for target in targets if target["type"] == "page")
    socket = await websocket_connect(page["webSocketDebuggerUrl"], max_message_size=2**28)
    number = 0
    try:
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            number += 1
            await socket.write_message(json.dumps({"id": number, "method": "Page.captureScreenshot"}))
            while (answer := json.loads(await socket.read_message())).get("id") != number:
                pass
            picture = matplotlib.image.imread(io.BytesIO(base64.b64decode(answer["result"]["data"])))[..., :3]
            if enough(picture) or time.monotonic() > until:
                return picture
    finally:
        socket.close()
        # the answer of the browser ends the connection
        await socket.read_message()
