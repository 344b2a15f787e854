"""Open pages in a headless Chromium and return their messages, elements, requests and pictures."""

import asyncio
import base64
import io
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
_SETTLED_S = 0.15


def seen(address: str, folder: Path, enough: Callable[[np.ndarray], bool], seconds: float) -> np.ndarray:
    """Return what a page shows, (height, width, 3) of 0 to 1, as soon as it is enough or time is up.

    Args:
        address: of the page; it may draw by WebGL and take its time.
        folder: takes the browser's files.
        enough: tells of a picture whether the page is drawn.
        seconds: to wait at most.
    """
    with _browser(folder, *_SOFTWARE_GRAPHICS, "--window-size=1200,800", address) as port_file:
        return asyncio.run(_watched(port_file, enough, time.monotonic() + seconds))


@dataclass(frozen=True)
class Visit:
    """A page as a narrow window shows it."""

    width: int
    """Width that the page takes, pixels; more than the window's if it scrolls sideways."""
    complaints: list[str]
    """Errors and warnings on the browser's console, and exceptions."""
    foreign: list[str]
    """Addresses of other hosts that the page asked for."""


def visited(addresses: list[str], folder: Path, width: int, seconds: float) -> dict[str, Visit]:
    """Open one page after the other in a window of the given width, and return what each is like.

    Args:
        addresses: of the pages.
        folder: takes the browser's files.
        width: of the window, pixels.
        seconds: for all pages together.
    """
    with _browser(folder, "--disable-gpu", "--disable-background-networking", "about:blank") as port_file:
        return asyncio.run(_visits(addresses, port_file, width, time.monotonic() + seconds))


@contextmanager
def _browser(folder: Path, *options: str) -> Iterator[Path]:
    """Start a browser with a DevTools port; yield the file that names the port."""
    assert CHROMIUM is not None
    profile = folder / "profile"
    unboxed = ["--no-sandbox"] if os.geteuid() == 0 else []
    common = ["--headless=new", "--no-first-run", "--hide-scrollbars", "--remote-debugging-port=0", *unboxed]
    browser = subprocess.Popen(
        [CHROMIUM, *common, f"--user-data-dir={profile}", *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield profile / "DevToolsActivePort"
    finally:
        browser.kill()
        browser.wait()


class _DevTools:
    """Commands to a page and the events that came meanwhile."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._number = 0
        self.events: list[dict[str, Any]] = []

    async def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        self._number += 1
        await self._socket.write_message(
            json.dumps({"id": self._number, "method": method, "params": parameters})
        )
        while (answer := await self._next()).get("id") != self._number:
            self.events.append(answer)
        result: dict[str, Any] = answer["result"]
        return result

    async def until(self, method: str) -> None:
        """Wait for an event that has not come yet."""
        while not any(event["method"] == method for event in self.events):
            self.events.append(await self._next())

    async def _next(self) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(await self._socket.read_message())
        return message

    async def close(self) -> None:
        self._socket.close()
        # the answer of the browser ends the connection
        while await self._socket.read_message() is not None:
            pass


async def _connected(port_file: Path, until: float) -> _DevTools:
    """Connect to the browser's first page by the DevTools protocol."""
    targets: list[dict[str, str]] = []
    while not any(target["type"] == "page" for target in targets):
        assert time.monotonic() < until, "the browser does not open the page"
        await asyncio.sleep(0.2)
        if port_file.exists() and (lines := port_file.read_text().split()):
            with urllib.request.urlopen(f"http://127.0.0.1:{lines[0]}/json", timeout=10) as reply:
                targets = json.load(reply)
    page = next(target for target in targets if target["type"] == "page")
    return _DevTools(await websocket_connect(page["webSocketDebuggerUrl"], max_message_size=2**28))


async def _watched(port_file: Path, enough: Callable[[np.ndarray], bool], until: float) -> np.ndarray:
    page = await _connected(port_file, until)
    try:
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            answer = await page.ask("Page.captureScreenshot")
            picture = matplotlib.image.imread(io.BytesIO(base64.b64decode(answer["data"])))[..., :3]
            if enough(picture) or time.monotonic() > until:
                return picture
    finally:
        await page.close()


async def _visits(addresses: list[str], port_file: Path, width: int, until: float) -> dict[str, Visit]:
    page = await _connected(port_file, until)
    try:
        for domain in ("Page", "Runtime", "Log", "Network"):
            await page.ask(f"{domain}.enable")
        await page.ask(
            "Emulation.setDeviceMetricsOverride", width=width, height=844, deviceScaleFactor=1, mobile=False
        )
        found: dict[str, Visit] = {}
        for address in addresses:
            assert time.monotonic() < until, f"no time left for {address}"
            page.events.clear()
            await page.ask("Page.navigate", url=address)
            await page.until("Page.loadEventFired")
            # what the page's scripts do after it was loaded counts too
            await asyncio.sleep(_SETTLED_S)
            size = await page.ask(
                "Runtime.evaluate", expression="document.documentElement.scrollWidth", returnByValue=True
            )
            found[address] = Visit(size["result"]["value"], *_faults(page.events))
        return found
    finally:
        await page.close()


def _faults(events: list[dict[str, Any]]) -> tuple[list[str], list[str]]:
    """Return the complaints and the foreign addresses among a page's events."""
    complaints: list[str] = []
    foreign: list[str] = []
    for event in events:
        given = event.get("params", {})
        match event["method"]:
            case "Runtime.exceptionThrown":
                complaints.append(given["exceptionDetails"]["text"])
            case "Runtime.consoleAPICalled" if given["type"] in ("error", "warning", "assert"):
                complaints.append(str(given["args"]))
            case "Log.entryAdded" if given["entry"]["level"] in ("error", "warning"):
                complaints.append(given["entry"]["text"])
            case "Network.requestWillBeSent":
                url = given["request"]["url"]
                if not url.startswith(("file:", "data:", "blob:", "about:")):
                    foreign.append(url)
    return complaints, foreign
