"""Edits of files. An edit is plain data, so that a failing input is kept as a few lines of JSON."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml


@dataclass(frozen=True)
class Edit:
    """One change of one file."""

    file: str
    """Path within the input's folder."""
    change: str
    """Name of a function of :data:`CHANGES`."""
    given: tuple[Any, ...] = ()
    """Arguments of the change, values that JSON holds."""

    def apply(self, folder: Path) -> None:
        """Change the file in ``folder``; a file that an earlier edit removed stays away."""
        path = folder / self.file
        if path.exists():
            CHANGES[self.change](path, *self.given)


def _put(path: Path, offset: int, value: str) -> None:
    """Overwrite bytes."""
    data, new = bytearray(path.read_bytes()), bytes.fromhex(value)
    data[offset : offset + len(new)] = new
    path.write_bytes(data)


def _insert(path: Path, offset: int, value: str) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:offset] + bytes.fromhex(value) + data[offset:])


def _cut(path: Path, offset: int, count: int) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:offset] + data[offset + count :])


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _as_folder(path: Path) -> None:
    _remove(path)
    path.mkdir()


def _rename(path: Path, name: str) -> None:
    if not path.with_name(name).exists():
        path.rename(path.with_name(name))


def _write(path: Path, value: str) -> None:
    path.write_bytes(bytes.fromhex(value))


def _lines(path: Path) -> list[bytes]:
    return path.read_bytes().split(b"\n")


def _word(path: Path, line: int, word: int, value: str) -> None:
    """Replace a word of a line."""
    lines = _lines(path)
    if line < len(lines) and word < len(words := lines[line].split(b" ")):
        words[word] = bytes.fromhex(value)
        lines[line] = b" ".join(words)
    path.write_bytes(b"\n".join(lines))


def _line(path: Path, line: int, action: str) -> None:
    """Remove, repeat, reverse or empty a line, or move it to the front."""
    lines = _lines(path)
    if line < len(lines):
        one = lines[line]
        lines[line : line + 1] = {"remove": [], "repeat": [one, one], "empty": [b""]}.get(action, [one])
        if action == "first":
            lines.insert(0, lines.pop(line))
        elif action == "reverse":
            lines[line] = b" ".join(reversed(one.split(b" ")))
    path.write_bytes(b"\n".join(lines))


def _array(path: Path, name: str, action: str) -> None:
    """Change one array of an .npz file; to objects, too, which readers must not unpickle."""
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files}
    if name in arrays:
        changed = ARRAY_ACTIONS[action](arrays.pop(name))
        if changed is not None:
            arrays[name] = changed
    np.savez(path, **arrays)


def _filled(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def fill(array: np.ndarray) -> np.ndarray:
        array = array.astype(np.float64) if array.dtype.kind in "biu" else np.array(array)
        with np.errstate(over="ignore"):
            array.reshape(-1)[::7] = value
        return array

    return fill


ARRAY_ACTIONS: dict[str, Callable[[np.ndarray], np.ndarray | None]] = {
    "remove": lambda array: None,
    "shorter": lambda array: array.reshape(-1)[:-1] if array.ndim < 2 else array[:-1],
    "longer": lambda array: np.concatenate([np.atleast_1d(array)] * 2),
    "none": lambda array: np.atleast_1d(array)[:0],
    "one": lambda array: np.atleast_1d(array)[:1],
    "flat": lambda array: array.reshape(-1),
    "deeper": lambda array: array[None],
    "scalar": lambda array: np.float64(3.0),
    "turned": lambda array: array.T,
    "narrow": lambda array: array[..., :2] if array.ndim else array,
    "text": lambda array: np.full(array.shape, "a"),
    "objects": lambda array: np.full(array.shape, None),
    "complex": lambda array: array.astype(complex),
    "bool": lambda array: array.astype(bool),
    "small": lambda array: array.astype(np.int8),
    "unsigned": lambda array: array.astype(np.uint64),
    "dates": lambda array: np.zeros(array.shape, "datetime64[ns]"),
    "named": lambda array: np.zeros(array.shape, [("x", float)]),
    "nan": _filled(np.nan),
    "inf": _filled(np.inf),
    "huge": _filled(1e300),
    "tiny": _filled(1e-320),
    "far": _filled(9e18),
    "negative": lambda array: -array if array.dtype.kind in "if" else array,
    "zero": lambda array: np.zeros_like(array),
    "backwards": lambda array: array[::-1] if array.ndim else array,
}
"""Changes of an array, by name; one that gives None removes it."""

VALUE_ACTIONS = ("nan", "inf", "huge", "tiny", "far", "negative", "zero", "backwards")
"""Those that keep the array's shape and the kind of its numbers."""


def _tree(path: Path, keys: list[Any], action: str, value: Any = None) -> None:
    """Change one node of a YAML or JSON file: replace it, or remove, rename or wrap it."""
    text = path.read_text()
    is_json = path.suffix == ".json"
    tree = json.loads(text) if is_json else yaml.safe_load(text)
    parent = tree
    for key in keys[:-1]:
        parent = parent[key]
    if not keys:
        tree = value
    elif action == "replace":
        parent[keys[-1]] = value
    elif action == "remove":
        del parent[keys[-1]]
    elif action == "rename" and isinstance(parent, dict):
        parent[value] = parent.pop(keys[-1])
    elif action == "wrap":
        parent[keys[-1]] = [parent[keys[-1]]]
    path.write_text(json.dumps(tree) if is_json else yaml.safe_dump(tree, sort_keys=False))


CHANGES: dict[str, Callable[..., None]] = {
    "put": _put,
    "insert": _insert,
    "cut": _cut,
    "remove": _remove,
    "as_folder": _as_folder,
    "rename": _rename,
    "write": _write,
    "word": _word,
    "line": _line,
    "array": _array,
    "tree": _tree,
}
"""All changes, by name."""
