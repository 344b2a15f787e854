"""No data that someone else made can run code: no source unpickles, evaluates text or gives it to a shell."""

import ast
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(
    path
    for folder in ("lio_jax", "experiments", "docs", "notebooks")
    for ending in ("*.py", "*.ipynb")
    for path in (ROOT / folder).rglob(ending)
    if "out" not in path.parts and ".ipynb_checkpoints" not in path.parts
)
MODULES = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
CALLS = {"eval", "exec", "compile", "__import__", "os.system", "os.popen"}
"""Calls of these names; methods that are called so, such as re.compile, are others."""
YAML = {"load", "load_all", "full_load", "full_load_all", "unsafe_load", "unsafe_load_all"}


def code_of(path: Path) -> str:
    """Return the code of a file; of a notebook without its commands for the shell."""
    if path.suffix == ".py":
        return path.read_text()
    cells = json.loads(path.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    return "\n".join(cell for cell in code if not cell.startswith(("%", "!")))


def unsafe(code: str) -> list[str]:
    """Return what code may not hold, with the numbers of its lines."""
    found = []
    for node in ast.walk(ast.parse(code)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name.partition(".")[0] for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [(node.module or "").partition(".")[0]]
        found += [f"{node.lineno}: {name}" for name in names if name in MODULES]
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            module, _, function = called.rpartition(".")
            given = {keyword.arg: keyword.value for keyword in node.keywords}
            if called in CALLS or function == "read_pickle" or (module == "yaml" and function in YAML):
                found.append(f"{node.lineno}: {called}")
            for word in ("shell", "allow_pickle"):
                if word in given and ast.unparse(given[word]) != "False":
                    found.append(f"{node.lineno}: {word}")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_source_runs_what_is_read(path):
    assert unsafe(code_of(path)) == []


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from joblib import load",
        "yaml.load(text)",
        "yaml.load(text, Loader=yaml.Loader)",
        "np.load(path, allow_pickle=True)",
        "np.load(path, allow_pickle=wanted)",
        "eval(text)",
        "exec(text)",
        "subprocess.run(text, shell=True)",
        "os.system(text)",
        "pandas.read_pickle(path)",
    ],
)
def test_what_is_unsafe_is_found(code):
    assert len(unsafe(f"a = 1\n{code}")) == 1


def test_what_is_safe_is_not_found():
    assert unsafe("import re\nre.compile(a)\nnp.load(a, allow_pickle=False)\nyaml.safe_load(a)") == []
