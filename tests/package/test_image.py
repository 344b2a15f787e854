"""The recipe of the container image: what it copies is there, and it runs as an ordinary user."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def instructions() -> list[tuple[str, str]]:
    """Return the Dockerfile's instructions with their arguments."""
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    return [(one, rest) for one, _, rest in (line.partition(" ") for line in lines) if one.isupper()]


def test_what_is_copied_is_in_the_context():
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {source for one, rest in instructions() if one == "COPY" for source in rest.split()[:-1]}
    assert copied == allowed
    assert [source for source in copied if not (ROOT / source).exists()] == []


def test_the_base_is_pinned_and_the_user_is_not_root():
    found = dict(instructions())
    assert re.fullmatch(r"python:3\.11-slim", found["FROM"])
    assert found["USER"] not in ("root", "0")
    assert found["ENTRYPOINT"] == '["lio-jax"]'


def test_no_host_is_named():
    assert re.findall(r"https?://|\.(?:io|com|org)\b", (ROOT / "Dockerfile").read_text()) == []
