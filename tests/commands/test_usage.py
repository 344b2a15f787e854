"""A command line that cannot be understood gives one sentence, which names what comes nearest."""

from dataclasses import dataclass
from importlib.metadata import version
from typing import Annotated, Literal

import pytest
import tyro
from tyro.conf import arg

from lio_jax.cli import main
from lio_jax.commands.runtime import usage_in_a_sentence
from lio_jax.core.errors import UsageError

WRONG = {
    "run a --out b --scans abc": "run: --scans must be a whole number, not 'abc'.",
    "run a --out b --scans=1.5": "run: --scans must be a whole number, not '1.5'.",
    "run --start ten a --out b": "run: --start must be a whole number, not 'ten'.",
    "run a --oot b": "run: unknown option '--oot'; did you mean --out?",
    "run a --out b --scan 3": "run: unknown option '--scan'; did you mean --scans?",
    "run a --out b --debgu": "run: unknown option '--debgu'; did you mean --debug?",
    "run a --out b --voxel=1": (
        "run: unknown option '--voxel=1'; the options are "
        "--out, --recipe, --set, --params-from, --start, --scans, --gt, --overwrite, --live, --resume."
    ),
    "run -x": (
        "run: unknown option '-x'; the options are "
        "--out, --recipe, --set, --params-from, --start, --scans, --gt, --overwrite, --live, --resume."
    ),
    "inspect a --jsn": "inspect: unknown option '--jsn'; did you mean --json?",
    "run": "run: needs DATA and --out DIR; --help explains the command.",
    "run a": "run: needs --out DIR; --help explains the command.",
    "eval a": "eval: needs either REFERENCE or --gps DATA; --help explains the command.",
    "run a --out": "run: a value is missing behind --out; write --out DIR.",
    "run a b --out c": "run: 'b' is more than the command takes; --help explains it.",
    "demo --overwrite yes": "demo: 'yes' is more than the command takes; --help explains it.",
    "": "give a command, one of {commands}; --help explains them.",
    "rn a": "unknown command 'rn'; did you mean 'run'?",
    "fly": "unknown command 'fly'; the commands are {commands}.",
    "--hepl": "unknown option '--hepl'; did you mean --help?",
    "--verison": "unknown option '--verison'; did you mean --version?",
    "--x": "unknown option '--x'; give a command first, one of {commands}.",
}


@pytest.mark.parametrize("line", WRONG)
def test_one_sentence_and_status_2(cli, line):
    from lio_jax.cli import app

    done = cli(*line.split())
    assert done.status == 2
    assert done.out == ""
    assert done.err == f"lio-jax: {WRONG[line].format(commands=', '.join(app._subcommands))}\n"


def test_the_version_is_that_of_the_package(cli):
    done = cli("--version")
    assert (done.status, done.out, done.err) == (0, f"lio-jax {version('lio-jax')}\n", "")


def test_debug_adds_the_traceback(cli):
    done = cli("run", "--debug")
    assert done.status == 2
    assert "Traceback" in done.err
    assert "run: needs DATA and --out DIR" in done.err


def test_without_the_event_tyro_speaks_for_itself(cli, monkeypatch):
    monkeypatch.delattr(tyro._errors, "on_parse_error")
    done = cli("run", "a", "--oot", "b")
    assert done.status == 2
    assert "Unrecognized options" in done.err


@dataclass(frozen=True)
class Noise:
    """Options that a command keeps in a dataclass."""

    gyro: Annotated[float | None, arg(metavar="X")] = None
    """Density."""
    offset: tuple[float, float, float] | None = None
    """Lever arm."""


def other_app():
    """Return an app whose command has options of kinds that lio-jax may come to use."""
    app = tyro.extras.SubcommandApp()

    @app.command(name="make")
    def make(
        rate: float,
        kind: Literal["bag", "native"] = "bag",
        noise: tyro.conf.OmitArgPrefixes[Noise] = Noise(),
    ) -> None:
        """Make something."""

    @app.command(name="look")
    def look() -> None:
        """Look."""

    return app


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("make --rate fast", "make: --rate must be a number, not 'fast'."),
        ("make --rate 1 --kind rosbag", "make: --kind must be one of bag, native, not 'rosbag'."),
        ("make --rate 1 --gyro low", "make: --gyro must be a number, not 'low'."),
        ("make --rate 1 --gyr 2", "make: unknown option '--gyr'; did you mean --gyro?"),
        ("make --rate 1 --offset 1 2 x", "make: --offset must be 3 numbers, not '1 2 x'."),
        ("look --kind bag", "look: unknown option '--kind'; the options are --help, --debug."),
    ],
)
def test_options_of_other_kinds(line, sentence):
    words = line.split()
    with pytest.raises(UsageError) as refused, usage_in_a_sentence(words, app := other_app()):
        app.cli(args=words)
    assert str(refused.value) == sentence


def test_help_stays_tyro_s(capfd):
    assert main(["run", "--help"]) == 0
    printed = capfd.readouterr()
    assert "usage: lio-jax run" in printed.out
    assert "--scans N" in printed.out
    assert printed.err == ""
