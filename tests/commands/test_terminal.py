"""The program as a shell sees it: exit status, streams, help, tracebacks only when asked for."""

import subprocess
import sys

import pytest

from lio_jax.commands.runtime import prepare_jax
from tests.commands.conftest import NOTES, PLAIN


def _shell(*words):
    command = [sys.executable, "-m", "lio_jax.cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_run_is_quiet_when_piped(folder, tmp_path):
    done = _shell("run", folder, "--scans", 3, *PLAIN, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr == NOTES
    assert done.stdout.startswith("scans      3  (")
    assert "\r" not in done.stdout + done.stderr


def test_errors_are_one_sentence(tmp_path):
    done = _shell("run", tmp_path / "nothing", "--out", tmp_path / "out")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"lio-jax: {tmp_path / 'nothing'}: no such file or folder; check the path.\n"


@pytest.mark.parametrize("place", [0, 4])
def test_debug_shows_the_traceback_and_keeps_the_status(cli, tmp_path, place):
    words = ["run", str(tmp_path / "nothing"), "--out", str(tmp_path / "out")]
    done = cli(*words[:place], "--debug", *words[place:])
    assert done.status == 1
    assert done.err.startswith("Traceback (most recent call last):")
    assert done.err.rstrip().endswith("nothing: no such file or folder; check the path.")
    assert cli(*words, "--set", "a=1", "--debug").status == 2


def test_output_cut_off_by_the_reader_is_no_error(folder):
    command = f"{sys.executable} -m lio_jax.cli inspect {folder} | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60)
    assert done.stderr == ""


@pytest.mark.parametrize(
    "words", [(), ("fly",), ("run",), ("run", "x"), ("eval", "x"), ("run", "x", "--far")]
)
def test_wrong_usage_says_so_on_standard_error(cli, words):
    done = cli(*words)
    assert done.status == 2
    assert done.out == ""
    assert "lio-jax" in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize("command", ["run", "eval", "inspect", "demo"])
def test_help(cli, command):
    done = cli(command, "--help")
    assert done.status == 0
    assert f"usage: lio-jax {command}" in done.out
    assert "{None}" not in done.out
    assert command in cli("--help").out


def test_unwritable_cache_is_no_error(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setenv("LIO_JAX_CACHE", str(tmp_path / "file" / "cache"))
    prepare_jax()
    assert (
        "cache cannot be written; compiled programs are not kept (set LIO_JAX_CACHE)."
        in capsys.readouterr().err
    )
