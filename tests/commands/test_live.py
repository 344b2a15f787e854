"""A run may be watched from this computer while it goes on; its files are written in full."""

import re

from lio_jax.commands import run as command
from tests import network
from tests.commands.conftest import Cli


def test_a_live_run_says_where_to_look_and_writes_its_recording(cli: Cli, folder, tmp_path, monkeypatch):
    before = network.listening()
    opened: list[set[tuple[str, int]]] = []

    def say(line: str) -> None:
        original(line)
        if line.startswith("live: "):
            opened.append(network.listening() - before)
            network.check_loopback_only(opened[-1])

    original = command.say
    monkeypatch.setattr(command, "say", say)
    options = ("--scans", "3", "--set", "config.output.plot=false", "config.output.report=false")
    done = cli("run", folder, "--out", tmp_path / "out", "--live", *options)
    assert done.status == 0, done.err
    (sockets,) = opened
    assert len(sockets) == 2
    assert not sockets & network.listening()
    assert re.search(r"^live: open http://127\.0\.0\.1:\d+\?url=rerun%2Bhttp%3A%2F%2F127", done.err, re.M)
    # nothing for a terminal alone where there is none
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f]", done.out + done.err)
    assert (tmp_path / "out" / "recording.rrd").stat().st_size > 10_000


def test_a_live_run_without_a_recording_is_refused(cli: Cli, folder, tmp_path):
    settings = ("--set", "config.output.recording=false")
    done = cli("run", folder, "--out", tmp_path / "out", "--live", *settings)
    assert done.status == 2
    assert "config.output.recording=false leaves it out" in done.err
    assert not (tmp_path / "out").exists()
