"""What the pages say exists: commands, settings, files, names."""

import ast
import fnmatch
import functools
import re
import shlex
from pathlib import Path

import pytest
import tyro

import lio_jax
from lio_jax import cli
from lio_jax.recipes import RECIPES
from lio_jax.settings.settings import declared_settings

ROOT = Path(__file__).parents[2]
README, DOCS = ROOT / "README.md", ROOT / "docs"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
MOST_LINES = 120
"""Of the README."""

_FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
_INDENTED = re.compile(r"(?:^    [^\n]*\n)+", re.MULTILINE)
_INLINE = re.compile(r"(?<!`)`(lio-jax [^`]+)`")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@functools.cache
def blocks(page: Path, language: str) -> list[str]:
    """Return a page's blocks of a language; indented ones count as bash."""
    text = page.read_text()
    found = [body for _, kind, body in _FENCE.findall(text) if kind == language]
    if language == "bash":
        found += _INDENTED.findall(_FENCE.sub("", text))
    return found


def commands(page: Path) -> list[list[str]]:
    """Return the words of each command line of lio-jax on a page."""
    lines = [
        line
        for block in blocks(page, "bash")
        for joined in block.replace("\\\n", " ").splitlines()
        for line in joined.split("&&")
    ]
    lines += [" ".join(line.split()) for line in _INLINE.findall(page.read_text())]
    split = [shlex.split(line, comments=True) for line in lines if line.strip().startswith("lio-jax ")]
    return [words[1:] for words in split]


@pytest.fixture
def parse(monkeypatch):
    """Return the command line with commands that do nothing: exit status 0 means that the words are right."""
    silent = tyro.extras.SubcommandApp()
    for name, command in cli.app._subcommands.items():
        silent.command(name=name)(functools.wraps(command.target)(lambda *args, **kwargs: None))
    monkeypatch.setattr(cli, "app", silent)

    def parsed(words: list[str]) -> bool:
        # a command named in a sentence, without its arguments
        return words in [[name] for name in silent._subcommands] or cli.main(words) == 0

    return parsed


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_the_command_line_knows_every_command(page, parse, capsys):
    wrong = [" ".join(words) for words in commands(page) if not parse(words)]
    assert wrong == [], capsys.readouterr().err


def test_a_wrong_option_is_found(parse):
    assert parse(["run", "my.bag", "--out", "out/my"])
    assert not parse(["run", "my.bag", "--out", "out/my", "--outt", "x"])
    assert not parse(["runn", "my.bag"])


@functools.cache
def setting_paths(*more: str) -> frozenset[str]:
    """Return the settings of all recipes of the package, and of more of them."""
    return frozenset(path for recipe in (*RECIPES, *more) for path in declared_settings(recipe))


def own_recipe(words: list[str]) -> list[str]:
    """Return the recipe of an example's file that a command names, if it names one."""
    named = words[words.index("--recipe") + 1] if "--recipe" in words[:-1] else ""
    path = ROOT / "experiments" / Path(named.partition(":")[0]).name
    return [f"{path}:{named.partition(':')[2]}"] if path.is_file() else []


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "settings.md"], ids=name_of)
def test_every_setting_on_a_page_exists(page):
    named = set(re.findall(r"(?<![\w.])((?:config|params)(?:\.[a-z][a-z0-9_]*){2})", page.read_text()))
    assert sorted(named - setting_paths()) == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_tuned_parameter_on_a_page_exists(page):
    for words in (words for words in commands(page) if "--params" in words[:-1]):
        given = words[words.index("--params") + 1].split(",")
        known = setting_paths(*own_recipe(words))
        assert [one for one in given if one != "GLOB" and not fnmatch.filter(known, f"params.{one}")] == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_file_and_target_on_a_page_exists(page):
    text = page.read_text()
    named = re.findall(r"(?<![\w/])((?:experiments|configs|docs|tests|lio_jax)/[\w/]+\.(?:py|yaml|md))", text)
    assert [path for path in named if not (ROOT / path).is_file()] == []
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    quoted = re.findall(r"`make ([a-z-]+)", text)
    assert [target for target in quoted if target not in targets] == []


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name_of)
def test_python_on_a_page_parses_and_imports_what_exists(page):
    for block in blocks(page, "python"):
        if block.startswith("--8<--"):
            continue
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module == "lio_jax":
                assert {one.name for one in node.names} <= set(lio_jax.__all__)


def test_the_readme_is_one_screen_and_its_links_exist():
    text = README.read_text()
    assert len(text.splitlines()) <= MOST_LINES
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert len(links) > 20
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_readme_names_both_commands_of_the_repository():
    assert {"make demo", "make test"} <= {
        " ".join(line.split()[:2]) for block in blocks(README, "bash") for line in block.splitlines() if line
    }


def test_the_list_of_names_is_the_public_one():
    documented = re.findall(r"^::: (\S+)$", (DOCS / "api.md").read_text(), re.MULTILINE)
    stub = (ROOT / "lio_jax" / "__init__.pyi").read_text()
    public = {
        f"lio_jax.{home}.{name}" for home, name in re.findall(r"^from \.(\S+) import (\w+)", stub, re.M)
    }
    assert sorted(documented) == sorted(public)
    assert {path.rpartition(".")[2] for path in documented} == set(lio_jax.__all__)


def test_the_version_is_the_same_everywhere():
    version = re.search(r'^version = "(.+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert version is not None
    assert f"\nversion: {version[1]}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {version[1]}" in (ROOT / "CHANGELOG.md").read_text()
