"""Text tables with one record a line: names of the columns, then numbers."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import read_text

_SEPARATOR = re.compile(r"\s*,\s*|\s+")


class TextTable(NamedTuple):
    """A table of n lines and k columns."""

    names: list[str] | None
    """Words of the last line before the numbers; None where the table begins with numbers."""
    line_numbers: list[int]
    """Line of the file, from 1, of each row."""
    words: list[list[str]]
    """Text of each row: a time in ns has more digits than a float holds."""
    values: NDArray[np.float64]
    """Numbers of each row, (n, k); NaN and infinity as they are written."""


def read_text_table(path: Path, content: str, remedy: str) -> TextTable:
    """Return the numbers of a table with commas or white space between its columns.

    Lines before the first number are names or comments; ``#`` and ``%`` before them do not count. The first
    row states the number of columns.

    Args:
        path: the file.
        content: what a row is, in the plural, for the sentence about a table without rows.
        remedy: what to do with a file that is no such table.

    Raises:
        LioJaxError: the file is no text, holds no row, or a row has another number of columns or a word that
            is no number.
    """
    text = enumerate(read_text(path, remedy).splitlines(), 1)
    lines = [(number, _words(line)) for number, line in text if line.strip()]
    names: list[str] | None = None
    while lines and _number(lines[0][1][0]) is None:
        names = lines.pop(0)[1]
    if not lines:
        raise LioJaxError(f"{path}: holds no {content}; {remedy}.")
    width = len(lines[0][1])
    rows = []
    for number, words in lines:
        row = [value for word in words if (value := _number(word)) is not None]
        if not len(row) == len(words) == width:
            raise LioJaxError(f"{path}: line {number} does not hold {width} numbers; fix or remove it.")
        rows.append(row)
    return TextTable(names, [number for number, _ in lines], [words for _, words in lines], np.array(rows))


def _words(line: str) -> list[str]:
    line = line.strip().lstrip("#%").strip()
    words = _SEPARATOR.split(line.rstrip(", \t"))
    # a name may contain blanks: "w_RS_S_x [rad s^-1]"
    is_named = _number(words[0]) is None and "," in line
    return [word.strip() for word in line.split(",")] if is_named else words


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
