"""What all commands share: settings of the process, and answers to wrong usage."""

import dataclasses
import difflib
import inspect
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import tyro

from lio_jax.core.errors import UsageError, one_line


def prepare_jax() -> None:
    """Turn on double precision and the persistent compilation cache.

    The cache is in $LIO_JAX_CACHE, else in $XDG_CACHE_HOME/lio_jax, else in ~/.cache/lio_jax. If it cannot be
    written, programs are compiled again each time.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    cache = Path(os.environ.get("LIO_JAX_CACHE") or Path(base) / "lio_jax")
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        say(f"note: {cache} cannot be written; compiled programs are not kept (set LIO_JAX_CACHE).")
        return
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@contextmanager
def ended_like_ctrl_c() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does: what was computed is written.

    A signal that is ignored, as under nohup, stays ignored.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before: dict[signal.Signals, Any] = {}
    # only the main thread may set handlers
    if threading.current_thread() is threading.main_thread():
        chosen = (signal.SIGTERM, signal.SIGHUP)
        before = {one: signal.getsignal(one) for one in chosen if signal.getsignal(one) == signal.SIG_DFL}
    try:
        for one in before:
            signal.signal(one, interrupt)
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def say(line: str) -> None:
    """Print a line to standard error, apart from the results on standard output.

    Notes and warnings are one line each, even if they name a topic with line breaks; tables may have several.
    """
    if line.startswith(("note: ", "warning: ")):
        line = one_line(line)
    print(line, file=sys.stderr, flush=True)


_EVERYWHERE = ("--help", "--debug")
_POSITIONAL = get_args(tyro.conf.Positional[int])[1]


@contextmanager
def usage_in_a_sentence(words: Sequence[str], app: tyro.extras.SubcommandApp) -> Iterator[None]:
    """Raise one sentence for words that tyro refuses within the block.

    Args:
        words: the command line.
        app: the application that reads the words in the block.

    Raises:
        UsageError: tyro refused the words.
    """
    events = getattr(tyro, "_errors", None)
    if not hasattr(events, "on_parse_error"):
        yield
        return

    def refuse(event: Any) -> None:
        commands = {name: command.target for name, command in app._subcommands.items()}
        if sentence := _usage_error(event, words, commands):
            raise UsageError(sentence)

    with events.on_parse_error(refuse):  # type: ignore[union-attr]
        yield


def _usage_error(event: Any, words: Sequence[str], commands: Mapping[str, Any]) -> str:
    """Return one sentence on an event of tyro's; return "" for an event of an unknown kind."""
    command = next((word for word in words if word in commands), "")
    if not command:
        return _wrong_command(words, commands)
    options = _options(commands[command])
    problem = _problem(event, words, options)
    return problem and f"{command}: {problem}{'?' if 'did you mean' in problem else '.'}"


def _problem(event: Any, words: Sequence[str], options: Mapping[str, Any]) -> str:
    kind = type(event).__name__
    if kind in ("UnrecognizedArgs", "MissingArgs"):
        tokens = event.tokens if kind == "UnrecognizedArgs" else event.unrecognized_tokens
        if unknown := next((token for token in tokens if token.startswith("-")), ""):
            return _unknown_option(unknown, options)
        if kind == "UnrecognizedArgs":
            return f"'{' '.join(tokens)}' is more than the command takes; --help explains it"
        missing = " and ".join(_shown(context.arg) for context in event.missing_arguments)
        return f"needs {missing}; --help explains the command"
    argument = getattr(event, "argument", None)
    if argument is None:
        return ""
    if argument.is_positional():
        unknown = next((word for word in words if word.startswith("-") and word not in options), "")
        return _unknown_option(unknown, options) if unknown else ""
    name = argument.lowered.name_or_flags[-1]
    if kind == "BadValue" and event.offending_value is None:
        return f"a value is missing behind {name}; write {_shown(argument)}"
    if kind == "BadValue":
        return f"{name} takes no value, but was given '{event.offending_value}'"
    if kind in ("InvalidChoice", "InstantiationFailure") and (wanted := _wanted(options.get(name))):
        return f"{name} must be {wanted}, not '{_given(name, words, argument)}'"
    return ""


def _wrong_command(words: Sequence[str], commands: Mapping[str, Any]) -> str:
    listed = ", ".join(commands)
    if not words:
        return f"give a command, one of {listed}; --help explains them."
    if words[0].startswith("-"):
        option = _nearest_option(words[0], (*_EVERYWHERE, "--version"))
        meant = f"did you mean {option}?" if option else f"give a command first, one of {listed}."
        return f"unknown option '{words[0]}'; {meant}"
    close = difflib.get_close_matches(words[0], commands, 1)
    meant = f"did you mean '{close[0]}'?" if close else f"the commands are {listed}."
    return f"unknown command '{words[0]}'; {meant}"


def _options(function: Any) -> dict[str, Any]:
    """Return the type of each option ``--name`` of a command, or of a dataclass of options."""
    options: dict[str, Any] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        kind = _bare(parameter.annotation)
        if dataclasses.is_dataclass(kind):
            options |= _options(kind)
        elif _POSITIONAL not in getattr(parameter.annotation, "__metadata__", ()):
            options["--" + name.rstrip("_").replace("_", "-")] = kind
    return options


def _bare(annotation: Any) -> Any:
    return annotation.__origin__ if hasattr(annotation, "__metadata__") else annotation


def _unknown_option(unknown: str, options: Mapping[str, Any]) -> str:
    close = _nearest_option(unknown, (*options, *_EVERYWHERE))
    known = f"did you mean {close}" if close else f"the options are {', '.join(options or _EVERYWHERE)}"
    return f"unknown option '{unknown}'; {known}"


def _nearest_option(unknown: str, options: Sequence[str]) -> str:
    # without the dashes, which make all options similar
    names = {option.lstrip("-"): option for option in options}
    close = difflib.get_close_matches(unknown.partition("=")[0].lstrip("-"), names, 1)
    return names[close[0]] if close else ""


def _shown(argument: Any) -> str:
    """Return an argument as its help writes it: DATA, or --out DIR."""
    metavar = str(argument.lowered.metavar)
    return metavar if argument.is_positional() else f"{argument.lowered.name_or_flags[-1]} {metavar}"


def _wanted(kind: Any) -> str:
    """Return words for the value that an option needs; return "" where this is not known."""
    alternatives = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    for alternative in alternatives:
        if get_origin(alternative) is Literal:
            return "one of " + ", ".join(map(str, get_args(alternative)))
        if get_origin(alternative) is tuple and get_args(alternative)[-1] is float:
            return f"{len(get_args(alternative))} numbers"
        if alternative in (int, float):
            return "a whole number" if alternative is int else "a number"
    return ""


def _given(name: str, words: Sequence[str], argument: Any) -> str:
    """Return the value or values that the words give for an option."""
    count = len(str(argument.lowered.metavar).split())
    given = ""
    for place, word in enumerate(words, 1):
        flag, joined, value = word.partition("=")
        if "--" + flag[2:].replace("_", "-") == name:
            given = value if joined else " ".join(words[place : place + count])
    return given
