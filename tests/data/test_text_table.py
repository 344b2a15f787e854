"""Tables as text: names, comments, separators, and lines that do not fit."""

from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.text_table import TextTable, read_text_table


def _read(folder: Path, text: str) -> TextTable:
    path = folder / "table.csv"
    path.write_text(text)
    return read_text_table(path, "samples", "give a table with the columns t, x")


@pytest.mark.parametrize(
    "text",
    ["1 2\n3 4\n", "1, 2\n\n3,4", "# a comment\n#t, x\n1\t2\n3 4\n", "% t x\n1 2\n3 4", "1,2,\n3 ,4,\n"],
)
def test_numbers_of_all_separators(tmp_path: Path, text: str) -> None:
    """Commas, tabs, blanks, empty lines and comments before the numbers do not change the numbers."""
    np.testing.assert_array_equal(_read(tmp_path, text).values, [[1.0, 2.0], [3.0, 4.0]])


def test_names_and_places(tmp_path: Path) -> None:
    """The last line before the numbers holds the names; rows know their line and all digits of a time."""
    table = _read(tmp_path, "#device 7\n# t [ns], x\n\n1700000000123456789, nan\n")
    assert table.names == ["t [ns]", "x"]
    assert table.line_numbers == [4]
    assert table.words[0][0] == "1700000000123456789"
    assert np.isnan(table.values[0, 1])


def test_rows_with_both_separators(tmp_path: Path) -> None:
    """A comma behind the time alone does not hide the columns after it."""
    np.testing.assert_array_equal(_read(tmp_path, "t, x\n1, 2 3\n4, 5 6\n").values, [[1, 2, 3], [4, 5, 6]])


def test_no_names(tmp_path: Path) -> None:
    """A table that begins with numbers has no names."""
    assert _read(tmp_path, "1 2\n").names is None


@pytest.mark.parametrize("line", ["3", "3 4 5", "3 x", "3,,4", "3,"])
def test_a_line_that_does_not_fit(tmp_path: Path, line: str) -> None:
    """The sentence names the line."""
    with pytest.raises(LioJaxError, match="line 3 does not hold 2 numbers"):
        _read(tmp_path, f"t x\n1 2\n{line}\n")


@pytest.mark.parametrize("text", ["", "\n \n", "t, x\n", "# nothing\n"])
def test_no_rows(tmp_path: Path, text: str) -> None:
    """A table without numbers is named as such, with what to give."""
    with pytest.raises(LioJaxError, match="holds no samples; give a table with the columns t, x"):
        _read(tmp_path, text)
