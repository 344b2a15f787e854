"""The house's rules: imports only go down, importing changes nothing and says nothing."""

import ast
import importlib
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import lio_jax

PACKAGE = Path(lio_jax.__file__).parent

FLOORS = {
    "core": 1,
    "imu": 2,
    "lidar": 2,
    "mapping": 2,
    "pose_graph": 2,
    "registration": 3,
    "estimation": 3,
    "loops": 3,
    "recipes": 4,
    "data": 4,
    "sim": 4,
    "settings": 5,
    "fusion": 5,
    "run": 6,
    "evaluation": 7,
    "tuning": 7,
    "ablation": 7,
    "inspection": 7,
    "viz": 7,
    "commands": 8,
    "evalio": 8,
    "cli": 8,
}

NEIGHBOURS = {
    ("sim", "data"),
    ("loops", "registration"),
    ("viz", "evaluation"),
    ("ablation", "evaluation"),
    ("ablation", "viz"),
    ("cli", "commands"),
    ("evalio", "commands"),
}
"""Imports within a floor, one way only: a simulated drive is a Sequence, a loop is aligned as a scan is, a
plot against truth is aligned as its score is, an ablation scores its runs and shows them as a run is shown,
a command line has commands, a harness prepares JAX as a command does."""

HEAVY = {
    "rerun",
    "evo",
    "matplotlib",
    "rosbags",
    "pypcd4",
    "distributed",
    "pyarrow",
    "laspy",
    "velodyne_decoder",
    "ouster",
}

FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def package_of(module: str) -> str:
    """Return the part of a name that has a floor, for example of lio_jax.run.track."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def module_name(path: Path) -> str:
    parts = ["lio_jax", *path.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.AST, module: str, is_package: bool) -> list[str]:
    """Return the full names of all modules imported anywhere in a file."""
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".") if is_package else module.split(".")[:-1]
                above = parts[: len(parts) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            # "from lio_jax import run" imports a package too
            names += [f"{base}.{alias.name}" for alias in node.names] if base == "lio_jax" else [base]
    return names


def violations(path: Path) -> list[str]:
    """Return the imports of one file that do not go down."""
    module = module_name(path)
    own = package_of(module)
    wrong = []
    for name in imported(ast.parse(path.read_text()), module, path.name == "__init__.py"):
        if name.split(".")[0] != "lio_jax":
            continue
        other = package_of(name)
        if other == own or (own, other) in NEIGHBOURS:
            continue
        if other not in FLOORS or FLOORS[other] >= FLOORS[own]:
            wrong.append(name)
    return wrong


@pytest.mark.parametrize("path", FILES, ids=lambda path: module_name(path))
def test_imports_only_go_down(path):
    assert violations(path) == []


def test_every_package_has_a_floor():
    packages = {path.name for path in PACKAGE.iterdir() if path.is_dir() and list(path.glob("*.py"))}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert packages | modules <= set(FLOORS)


def test_the_rule_can_see_an_upward_import(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    core = tmp_path / "core"
    core.mkdir()
    for text in (
        "from lio_jax.run.run import run_sequence",
        "import lio_jax.viz.plot",
        "from lio_jax import recipes",
        "from ..mapping import voxel_map",
        "def late():\n    from lio_jax.sim.open_worlds import street",
    ):
        (core / "bad.py").write_text(text)
        assert violations(core / "bad.py"), text
    (core / "good.py").write_text(
        "from lio_jax.core.types import Scan\nfrom .config import Config\nimport numpy"
    )
    assert violations(core / "good.py") == []


MODULE_OF = {"rerun-sdk": "rerun", "pyyaml": "yaml", "lazy-loader": "lazy_loader"}
"""Modules that are not called as the package that brings them."""
BROUGHT_ALONG = {"dask", "psutil", "lz4"}
"""Modules that a dependency needs itself: distributed the first two, rosbags lz4."""
OPTIONAL = {"evalio", "laspy", "velodyne_decoder", "ouster"}
"""Modules that an extra or a command of its own brings; without them one sentence says so."""


def test_what_the_package_imports_is_installed_with_it():
    with (PACKAGE.parent / "pyproject.toml").open("rb") as file:
        declared = tomllib.load(file)["project"]["dependencies"]
    names = {re.split(r"[<>=]", one)[0] for one in declared}
    brought = {MODULE_OF.get(name, name) for name in names}
    used = {"lazy_loader"}
    for path in FILES:
        tree, is_package = ast.parse(path.read_text()), path.name == "__init__.py"
        used |= {name.split(".")[0] for name in imported(tree, module_name(path), is_package)}
    used -= {"lio_jax", *sys.stdlib_module_names}
    assert used - brought == BROUGHT_ALONG | OPTIONAL


MODULES = {module_name(path): path for path in FILES}
MOST_MODULES = 310
"""Limit of the number of files: a new one earns its place, or another one goes."""


def modules_imported(module: str) -> set[str]:
    """Return the package's modules that one of them names in its imports, those within functions too."""
    path, found = MODULES[module], set()
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Import | ast.ImportFrom):
            continue
        for base in imported(node, module, path.name == "__init__.py"):
            # what is taken from a package may be a module of it
            parts = {f"{base}.{alias.name}" for alias in node.names} & set(MODULES)
            found |= parts or {base} & set(MODULES)
    return found - {module}


def cycle_in(graph: dict[str, set[str]]) -> list[str]:
    """Return the names along one cycle, or none."""
    done: set[str] = set()
    for start in graph:
        path, open_names = [start], [iter(sorted(graph[start]))]
        while path:
            following = next((name for name in open_names[-1] if name not in done), None)
            if following is None:
                done.add(path.pop())
                open_names.pop()
            elif following in path:
                return [*path[path.index(following) :], following]
            else:
                path.append(following)
                open_names.append(iter(sorted(graph[following])))
    return []


def test_no_module_imports_itself_by_way_of_others():
    assert cycle_in({module: modules_imported(module) for module in MODULES}) == []


def test_the_rule_can_see_a_cycle():
    assert cycle_in({"a": {"b", "d"}, "b": {"c"}, "c": {"a"}, "d": set()}) == ["a", "b", "c", "a"]
    assert cycle_in({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    assert "lio_jax.core.types" in modules_imported("lio_jax.recipes.recipe")


def test_there_are_not_too_many_modules():
    assert len(list(PACKAGE.rglob("*.py"))) <= MOST_MODULES


PUBLIC = [
    (node.module or "", alias.asname or alias.name)
    for node in ast.parse((PACKAGE / "__init__.pyi").read_text()).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
]


@pytest.mark.parametrize(("module", "name"), PUBLIC)
def test_every_public_name_is_there(module, name):
    if module:
        defined = getattr(importlib.import_module(f"lio_jax.{module}"), name)
    else:
        defined = importlib.import_module(f"lio_jax.{name}")
    assert getattr(lio_jax, name) is defined
    assert name in lio_jax.__all__


def run_python(code: str) -> subprocess.CompletedProcess:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    environment["JAX_PLATFORMS"] = "cpu"
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=environment,
        cwd=PACKAGE.parent,
        timeout=120,
        check=False,
    )


EVERY_MODULE = """
import importlib.util, pkgutil, sys
import jax
before = dict(jax.config.values)
import lio_jax
names = [m.name for m in pkgutil.walk_packages(lio_jax.__path__, 'lio_jax.')]
# an extra, which may be missing
known = importlib.util.find_spec('evalio') is not None
for name in names:
    if not name.endswith('__main__') and (known or not name.startswith('lio_jax.evalio')):
        importlib.import_module(name)
assert len(names) > 40, names
after = dict(jax.config.values)
changed = {key for key in after if after[key] != before.get(key)}
assert not changed, changed
assert jax.numpy.zeros(1).dtype == 'float32'
"""


def test_importing_every_module_changes_no_setting_of_jax_and_prints_nothing():
    done = run_python(EVERY_MODULE)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert done.stderr == ""


def test_heavy_libraries_are_not_imported_with_the_package():
    done = run_python(f"import sys, lio_jax, lio_jax.cli; print(sorted({HEAVY!r} & set(sys.modules)))")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_no_module_prints_outside_the_command_line():
    """Results go through return values and files; only commands speak to the terminal."""
    speaking = []
    for path in FILES:
        if package_of(module_name(path)) in ("commands", "cli"):
            continue
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        if any(isinstance(call.func, ast.Name) and call.func.id == "print" for call in calls):
            speaking.append(module_name(path))
    assert speaking == []
