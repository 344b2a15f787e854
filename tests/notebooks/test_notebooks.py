"""Each notebook runs from a clean kernel, and lies in the repository without outputs."""

import os
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
PICTURES = {
    "01_first_run": 4,
    "02_inside_one_scan": 4,
    "03_gradient_and_tuning": 2,
    "04_ablation": 1,
    "05_your_own_bag": 2,
    "06_calibrate_a_lidar": 2,
    "07_write_a_recipe": 2,
}


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Set a kernel's environment: this installation's commands, and no settings of the user."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    places = [str(ROOT), str(ROOT / "notebooks"), os.environ.get("PYTHONPATH", "")]
    environment = {
        "PATH": path,
        "PYTHONPATH": os.pathsep.join(filter(None, places)),
        "IPYTHONDIR": str(tmp_path / "ipython"),
    }
    for name, value in environment.items():
        monkeypatch.setenv(name, value)


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def test_all_notebooks_are_known():
    assert [path.stem for path in NOTEBOOKS] == sorted(PICTURES)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path):
    notebook = read(path)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_a_clean_kernel(path, tmp_path, kernel):
    """A cell that raises, or a command that fails, fails the test."""
    notebook, folder = read(path), tmp_path / "work"
    folder.mkdir()
    place = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, kernel_name="python3", timeout=600, resources=place).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == PICTURES[path.stem]
    assert not [output.text for output in outputs if "Warning" in output.get("text", "")]
