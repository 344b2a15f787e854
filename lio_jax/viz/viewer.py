"""Run rerun's viewer in separate processes, reachable from this computer only."""

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote

from lio_jax.core.errors import LioJaxError

_LOOPBACK = "127.0.0.1"
_START_S = 30.0
_STOP_S = 5.0
_POLL_S = 0.05


@dataclass(frozen=True)
class Server:
    """A viewer that is served to browsers on this computer."""

    page: str
    """Address to open in a browser."""
    stream: str
    """Address to which a recording is sent."""
    process: subprocess.Popen[bytes]


@contextmanager
def served(recording: Path | None = None) -> Iterator[Server]:
    """Serve the web viewer on loopback during the block.

    Args:
        recording: an .rrd file to show; None: the data that is sent to the stream's address.

    Raises:
        LioJaxError: the viewer does not start.
    """
    data_port, page_port = _free_ports(2)
    ports = ["--port", str(data_port), "--web-viewer-port", str(page_port)]
    stream = f"rerun+http://{_LOOPBACK}:{data_port}/proxy"
    page = f"http://{_LOOPBACK}:{page_port}?url={quote(stream, safe='')}"
    with tempfile.TemporaryDirectory() as home:
        process = subprocess.Popen(
            [*_rerun(), *([str(recording)] if recording else []), "--serve-web", "--bind", _LOOPBACK, *ports],
            env=_without_usage_data(Path(home)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # Ctrl-C goes to the process that started the viewer, which then ends the viewer
            start_new_session=True,
        )
        try:
            for port in (data_port, page_port):
                _wait(process, port)
            yield Server(page, stream, process)
        finally:
            _end(process)


def show(recording: Path) -> None:
    """Open the viewer's own window, and wait until the user closes it.

    Raises:
        LioJaxError: there is no screen, or the viewer ended at once.
    """
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not screen:
        raise LioJaxError("there is no screen to open a window on; add --web to look with a browser.")
    with tempfile.TemporaryDirectory() as home:
        done = subprocess.run(
            [*_rerun(), str(recording), "--bind", _LOOPBACK, "--port", "auto"],
            env=_without_usage_data(Path(home)),
            check=False,
        )
    if done.returncode:
        raise LioJaxError(
            f"the viewer ended with status {done.returncode}; add --web to look with a browser."
        )


def _rerun() -> list[str]:
    """Return the viewer's program itself: the end of its Python wrapper would leave it running."""
    found = find_spec("rerun_cli")
    for folder in (found.submodule_search_locations or []) if found else []:
        for name in ("rerun", "rerun.exe"):
            if (program := Path(folder) / name).is_file():
                return [str(program)]
    return [sys.executable, "-m", "rerun"]


def _without_usage_data(home: Path) -> dict[str, str]:
    """Return an environment in which the viewer's settings, in ``home``, turn off its usage data."""
    settings = home / "rerun" / "analytics.json"
    settings.parent.mkdir()
    settings.write_text(json.dumps({"analytics_enabled": False, "analytics_id": "", "metadata": {}}))
    return os.environ | {"XDG_CONFIG_HOME": str(home), "XDG_DATA_HOME": str(home)}


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for one in sockets:
            one.bind((_LOOPBACK, 0))
        return [one.getsockname()[1] for one in sockets]
    finally:
        for one in sockets:
            one.close()


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _wait(process: subprocess.Popen[bytes], port: int) -> None:
    """Wait until the process accepts connections at a port."""
    until = time.monotonic() + _START_S
    while time.monotonic() < until and process.poll() is None:
        with socket.socket() as probe:
            probe.settimeout(1.0)
            if probe.connect_ex((_LOOPBACK, port)) == 0:
                return
        time.sleep(_POLL_S)
    ended = "ended" if process.poll() is not None else "does not answer"
    raise LioJaxError(f"the viewer {ended}; look at the recording with 'rerun FILE.rrd'.")
