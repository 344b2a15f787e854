"""The viewer is served on loopback, to this computer alone, and ends with the block."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from lio_jax.cli import main
from lio_jax.core.errors import LioJaxError
from lio_jax.viz import viewer
from lio_jax.viz.recording import ViewerRecording
from lio_jax.viz.viewer import served
from tests.network import check_loopback_only
from tests.viz.browser import needs_browser, seen


def short(path: Path, live: str | None = None) -> Path:
    with ViewerRecording(path, scan_count=2, live=live) as recording:
        for index in range(2):
            recording.log_scan(index, index, np.ones((10, 3), np.float32), np.eye(4))
    return path


def answer(page: str) -> bytes:
    with urllib.request.urlopen(page, timeout=30) as reply:
        return reply.read()


def port_of(address: str) -> int:
    return int(re.search(r":(\d+)", address.split("//", 1)[1]).group(1))


def listening(port: int) -> set[str]:
    """Return the addresses that listen at a port, hexadecimal as the kernel prints them."""
    rows = [
        line.split()
        for table in ("tcp", "tcp6")
        for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]
    ]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and int(row[1].split(":")[1], 16) == port}


def test_a_recording_is_served_on_loopback_and_no_longer_than_the_block(tmp_path):
    with served(short(tmp_path / "a.rrd")) as server:
        ports = [port_of(server.page), port_of(server.stream)]
        assert b"<html" in answer(server.page).lower()
        if Path("/proc/self/net/tcp").exists():
            # 127.0.0.1 and nothing else
            assert [listening(port) for port in ports] == [{"0100007F"}] * 2
        check_loopback_only({("127.0.0.1", port) for port in ports})
    for port in ports:
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", port)) != 0


def coloured(picture: np.ndarray) -> float:
    """Return the share of the world's view that is red."""
    height, width, _ = picture.shape
    red, green, blue = np.moveaxis(picture[height // 8 :, : 2 * width // 3], -1, 0)
    return float(np.mean((red > 0.6) & (green < 0.4) & (blue < 0.4)))


@needs_browser
def test_a_browser_draws_the_world(tmp_path, pictures):
    """A fence of refused loops fills a good part of the canvas, on which nothing else is red."""
    fence = np.zeros((400, 2, 3))
    fence[:, :, 1] = np.linspace(-6, 6, 400)[:, None]
    fence[:, :, 2] = [-4, 4]
    with ViewerRecording(tmp_path / "recording.rrd", scan_count=2) as recording:
        for index in range(2):
            recording.log_scan(index, index, fence[:, 0].astype(np.float32), np.eye(4))
            recording.log_correction(
                fence[:2, 0], fence[:2, 0], {"closed": np.zeros((0, 2, 3)), "refused": fence}
            )
    with served(tmp_path / "recording.rrd") as server:
        picture = seen(server.page, tmp_path, lambda picture: coloured(picture) > 0.02, 90.0)
    matplotlib.image.imsave(pictures / "viewer.png", picture)
    assert coloured(picture) > 0.02


def test_a_live_recording_reaches_the_server_and_the_file(tmp_path):
    from rerun.chunk import RrdReader

    with served() as server:
        path = short(tmp_path / "live.rrd", server.stream)
        alone = short(tmp_path / "alone.rrd")
    counts = [
        sorted((chunk.entity_path, chunk.num_rows) for chunk in RrdReader(file).stream())
        for file in (path, alone)
    ]
    assert counts[0] == counts[1] != []


def test_a_viewer_that_does_not_start_is_an_error(monkeypatch):
    monkeypatch.setattr(viewer, "_rerun", lambda: [sys.executable, "-c", "raise SystemExit(3)"])
    with pytest.raises(LioJaxError, match="the viewer ended"), served():
        pytest.fail("the block was entered")


def test_without_a_screen_the_browser_is_named(tmp_path, monkeypatch, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    path = short(tmp_path / "recording.rrd")
    assert main(["view", str(path)]) == 1
    assert "add --web" in capsys.readouterr().err


def test_a_folder_without_a_recording_is_refused(tmp_path, capsys):
    assert main(["view", str(tmp_path)]) == 2
    assert f"{tmp_path / 'recording.rrd'}: is not there" in capsys.readouterr().err


def test_the_command_serves_until_it_is_interrupted(tmp_path):
    short(tmp_path / "recording.rrd")
    command = [sys.executable, "-m", "lio_jax.cli", "view", str(tmp_path), "--web"]
    # a shell that runs this in the background has Ctrl-C ignored
    heed = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ, **heed) as process:
        page = process.stderr.readline().removeprefix("open ").strip()
        assert page.startswith("http://127.0.0.1:")
        assert answer(page)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    time.sleep(0.1)
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port_of(page))) != 0
