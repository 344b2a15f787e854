"""Draw damage that keeps most of a file's structure, so that it reaches the code behind the first check."""

import functools
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import yaml

from experiments.fuzz.edits import ARRAY_ACTIONS, VALUE_ACTIONS, Edit
from experiments.fuzz.layouts import NUMBERS, Number

Draw = Callable[[Path, str, Random], Edit]
"""Draws one edit of a file, which is named within a folder."""

_WORDS = (
    *("nan", "inf", "-inf", "1e400", "-1e400", "1e-320", "1e300", "-1", "0", "", "-", ".", "1.5.2", "0x10"),
    *("99999999999999999999999", "9223372036854775807", "-9223372036854775809", "18446744073709551616"),
    *("1_000", "٣", "²", "1.²", "½", "ä", "#", ",", "1,5", "True", "None", "0.0001", "1e30", "1e18", "7e9"),
    *("a" * 300, "1" * 5000, "NaT", "2262-12-31", "1600-01-01", "%s", "{}", "\x00", "\u2028", "\r", "-0"),
)
_BYTES = (b"\xff", b"\xff\xfe", b"\xef\xbb\xbf", b"\x00", b"\xc3\x28", b"\xe9", b"\r\n", b"\x1a", b"\x85")
_VALUES: tuple[Any, ...] = (
    *(None, [], {}, "", "text", "ä", -1, 0, 1, 0.5, -0.0, True, False, 1e300, -1e300, 1e-320),
    *(float("nan"), float("inf"), 10**30, 2**31, 2**63, 10**9, "1e400", ["a"], [None], [[1]], {"a": 1}),
    *(
        [1, 2],
        [0, 0, 0, 0],
        [float("nan")] * 4,
        [1e200] * 4,
        [True, False, True],
        "yes",
        "/",
        "..",
        "%",
        "{}",
    ),
    *("auto", "default", "lio_sam", "nowhere.py:X", "0x10", "12:30:45", {1: 2}, [{}], "a" * 2000),
)
_YAML_TEXTS = (
    *(b"\t", b"*a", b"&a [*a]", b"!!python/object/apply:os.system ['true']", b"!!binary abc", b"2020-13-45"),
    *(
        b"{",
        b"[",
        b": :",
        b"? ",
        b"- ",
        b"%YAML 9.9\n",
        b"---\n",
        b"<<: 3\n",
        b"1: {2: 3}\n",
        b"'",
        b'"',
        b"|",
    ),
    *(b"2001-01-01", b"!!float abc", b"!!int x", b"0b", b"1:99:99", b"!!timestamp 9", b"{[1]: 2}", b"\xff"),
    *(b"[" * 3000, b"{a: " * 500, b"0" * 5000, b"9" * 5000, b"? [1, 2]\n: 3\n", b"=: 3\n", b"~: 3\n"),
)


def number(layout: str) -> Draw:
    """Return a draw that changes a number which decides how a file of that layout is read."""

    def draw(folder: Path, file: str, random: Random) -> Edit:
        path = folder / file
        chosen = random.choice(_numbers(layout, path, path.stat().st_mtime_ns))
        data = path.read_bytes()[chosen.offset : chosen.offset + chosen.size]
        order = "big" if chosen.big_endian else "little"
        value = _other(int.from_bytes(data, order), 8 * chosen.size, random)
        return Edit(file, "put", (chosen.offset, value.to_bytes(chosen.size, order).hex()))

    return draw


@functools.cache
def _numbers(layout: str, path: Path, changed_ns: int) -> list[Number]:
    data = path.read_bytes()
    found = [one for one in NUMBERS[layout](data) if one.offset + one.size <= len(data)]
    return found or [Number(0, 1)]


def _other(value: int, bits: int, random: Random) -> int:
    """Return a whole number that is likely to be mishandled."""
    far = random.randrange(1 << random.randint(1, bits))
    near = value + random.choice((-1, 1, 2, 7, -4, 16))
    edge = random.choice((0, 1, (1 << bits) - 1, 1 << (bits - 1), (1 << (bits - 1)) - 1))
    scaled = random.choice((value * 2, value * 1000, value >> 1, value << 8, value ^ (1 << (bits - 1))))
    return random.choice((far, near, edge, scaled)) % (1 << bits)


def raw(folder: Path, file: str, random: Random) -> Edit:
    """Change bytes without regard to what they mean."""
    size = (folder / file).stat().st_size
    offset = random.randrange(size + 1)
    noise = random.randbytes(random.choice((1, 1, 2, 4, 8, 64)))
    return random.choice(
        (
            Edit(file, "put", (min(offset, max(size - len(noise), 0)), noise.hex())),
            Edit(file, "insert", (offset, noise.hex())),
            Edit(file, "cut", (offset, random.choice((1, 4, 100, size)))),
            Edit(file, "put", (offset, bytes(min(64, max(size - offset, 0))).hex())),
        )
    )


def whole(folder: Path, file: str, random: Random) -> Edit:
    """Remove, empty, replace or rename a whole file."""
    suffix = Path(file).suffix
    names = (
        f"999999999999{suffix}",
        f"-1{suffix}",
        f"²{suffix}",
        f"0{suffix}",
        f"a b{suffix}",
        f"1e9{suffix}",
    )
    return random.choice(
        (
            Edit(file, "remove"),
            Edit(file, "as_folder"),
            Edit(file, "write", ("",)),
            Edit(file, "write", (random.randbytes(40).hex(),)),
            Edit(file, "write", (b"<html>404 not found</html>".hex(),)),
            Edit(file, "rename", (random.choice(names),)),
        )
    )


def text(folder: Path, file: str, random: Random) -> Edit:
    """Change a word or a line of a text file, or put bytes into it that are not UTF-8."""
    data = (folder / file).read_bytes()
    lines = data.split(b"\n")
    line = random.randrange(len(lines))
    word = random.randrange(len(lines[line].split(b" ")))
    kind = random.randrange(8)
    if kind < 5:
        return Edit(file, "word", (line, word, random.choice(_WORDS).encode().hex()))
    if kind == 5:
        return Edit(file, "insert", (random.randrange(len(data) + 1), random.choice(_BYTES).hex()))
    if kind == 6:
        return Edit(file, "line", (line, random.choice(("remove", "repeat", "empty", "first", "reverse"))))
    return Edit(file, "cut", (random.randrange(len(data) + 1), random.choice((1, 3, 20, len(data)))))


def array(folder: Path, file: str, random: Random) -> Edit:
    """Change one array of an .npz file; of other files some bytes."""
    if not file.endswith(".npz"):
        return raw(folder, file, random)
    with np.load(folder / file) as held:
        name = random.choice(held.files)
    return Edit(file, "array", (name, random.choice(list(ARRAY_ACTIONS))))


def tree(folder: Path, file: str, random: Random) -> Edit:
    """Change one node of a YAML or JSON file, or put text into it that YAML reads in a strange way."""
    data = (folder / file).read_bytes()
    if random.random() < 0.25 and not file.endswith(".json"):
        begins = [0, *(place + 1 for place, byte in enumerate(data) if byte in b"\n :[")]
        return Edit(file, "insert", (random.choice(begins), random.choice((*_YAML_TEXTS, *_BYTES)).hex()))
    keys = random.choice(_nodes(yaml.safe_load(data)))
    action = random.choice(("replace", "replace", "replace", "remove", "rename", "wrap"))
    value = (
        random.choice(_VALUES) if action == "replace" else random.choice((None, 3, "ä", "", True, "a.b.c"))
    )
    return Edit(file, "tree", (keys, action, value))


def fitting(folder: Path, file: str, random: Random) -> Edit:
    """Change a file in the way that its ending suggests."""
    suffix = Path(file).suffix
    return {".npz": array, ".yaml": tree, ".json": tree, ".tum": text, ".txt": text}.get(suffix, raw)(
        folder, file, random
    )


def sound_array(folder: Path, file: str, random: Random) -> Edit:
    """Change the values of one array of an .npz file, and neither its shape nor its type."""
    with np.load(folder / file) as held:
        name = random.choice(held.files)
    return Edit(file, "array", (name, random.choice(VALUE_ACTIONS)))


def _nodes(node: Any, keys: tuple[Any, ...] = ()) -> list[list[Any]]:
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    found = [list(keys)]
    for key, child in children:
        found += _nodes(child, (*keys, key))
    return found
