"""Judge what a command did with a damaged file."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ACCEPTED, REFUSED = "accepted", "refused"
FAILURES = (
    "traceback",
    "unexpected",
    "unclear",
    "stray",
    "hang",
    "memory",
    "died",
    "not finite",
    "outside",
)
"""Verdicts that a user must never meet, the gravest first among those that one command may earn."""

_LONGEST = 1200
_EXCEPTION = re.compile(r"\b[A-Z]\w*(Error|Exception|Warning|Exit)\b|object at 0x|unexpected [A-Z]\w+:")
_NOT_FINITE = re.compile(r"(?<![\w.])[-+]?(nan|inf|infinity)(?![\w.])", re.IGNORECASE)
_SENTENCES_NUMBER = re.compile(r"NaN or infinity|\((nan|inf)[^)]*\)", re.IGNORECASE)
"""What a sentence may say of values that were left out."""
_TEXTS = dict.fromkeys((".tum", ".txt", ".g2o"), _NOT_FINITE) | {".yaml": re.compile(r"\.(nan|inf)\b")}
"""What is not finite, by the ending of a result."""


@dataclass(frozen=True)
class Done:
    """What is known of a command that has ended."""

    status: int | None
    """Exit status; None where the process had to be ended or died."""
    out: str
    err: str
    ended: str = ""
    """Why there is no exit status: hang, memory or died."""
    outside: tuple[str, ...] = ()
    """What was written outside the folder for results."""
    grown: int = 0
    """Memory that the command took beyond what the process held before, bytes."""


@dataclass(frozen=True)
class Verdict:
    """The name of a verdict, and what shows it."""

    name: str
    evidence: str = ""

    @property
    def failed(self) -> bool:
        """Whether the program is at fault."""
        return self.name in FAILURES


def judge(
    done: Done, folder: Path, results: Path, most_bytes: int, ends: str, may_be_nan: tuple[str, ...]
) -> Verdict:
    """Return the verdict on a command.

    Args:
        done: what the command did.
        folder: the input's folder, which a refusal has to name.
        results: where the command was to write.
        most_bytes: memory that a command may take.
        ends: regular expression of a refusal that counts as acceptance; "": there is none.
        may_be_nan: arrays of results that may hold values that are not finite.
    """
    lines = done.err.splitlines()
    last = lines[-1] if lines else ""
    if done.ended:
        return Verdict(done.ended, last)
    if "Traceback (most recent call last)" in done.err or done.status == -1:
        return Verdict("traceback", last)
    if last.startswith("lio-jax: unexpected "):
        return Verdict("unexpected", last)
    if done.grown > most_bytes:
        return Verdict("memory", f"{done.grown / 2**30:.1f} GiB")
    if done.outside:
        return Verdict("outside", done.outside[0])
    if strange := next((line for line in lines if not _spoken(line)), ""):
        return Verdict("stray", strange)
    if jargon := next((line for line in lines if _EXCEPTION.search(line) or len(line) > _LONGEST), ""):
        return Verdict("unclear", jargon[:_LONGEST])
    if done.status:
        if not last.startswith("lio-jax: ") or not last.endswith((".", "?")):
            return Verdict("unclear", last)
        if ends and re.search(ends, last):
            return Verdict(ACCEPTED)
        if str(folder) not in last and str(results) not in last:
            return Verdict("unclear", last)
        return Verdict(REFUSED, last)
    if _prints_not_finite(done.out):
        return Verdict("not finite", "in the printed result")
    for path in sorted(results.rglob("*")):
        if found := _not_finite(path, may_be_nan):
            return Verdict("not finite", found)
    return Verdict(ACCEPTED, last)


def _spoken(line: str) -> bool:
    """Return whether a line of standard error is of a form that the commands have."""
    known = ("note: ", "warning: ", "lio-jax: ", "  ", "not taken:", "failed: ")
    return not line or line.startswith(known) or "'s parameters, recipe " in line or " runs" in line


def _prints_not_finite(out: str) -> bool:
    """Return whether a printed result holds a number that is not finite; a sentence may speak of one."""
    constants: list[str] = []
    try:
        json.loads(out, parse_constant=constants.append)
    except ValueError:
        return bool(_NOT_FINITE.search(_SENTENCES_NUMBER.sub("", out)))
    return bool(constants)


def _not_finite(path: Path, may_be_nan: tuple[str, ...]) -> str:
    """Return where a result holds a value that is not finite; "" where it does not."""
    if path.suffix == ".json":
        constants: list[str] = []
        json.loads(path.read_text(), parse_constant=constants.append)
        return f"{path.name}: {constants[0]}" if constants else ""
    if path.suffix in _TEXTS and path.is_file():
        found = _TEXTS[path.suffix].search(path.read_text())
        return f"{path.name}: {found[0]}" if found else ""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            for name in arrays.files:
                array = arrays[name]
                if name not in may_be_nan and array.dtype.kind == "f" and not np.isfinite(array).all():
                    return f"{path.name}: {name}"
    return ""
