"""Show the notebooks as pages of the site.

A notebook lies in the repository without outputs. Its page shows the text and the code. The pictures and
printed lines are shown too where ``make docs-notebooks`` has left an executed copy in ``out/notebooks``.
"""

import base64
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

_ROOT = Path(__file__).parents[2]
_FOLDER = "notebooks"
_EXECUTED = _ROOT / "out" / "notebooks"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook, and the pictures of the executed ones."""
    for path in sorted((_ROOT / "notebooks").glob("*.ipynb")):
        executed = _EXECUTED / path.name
        notebook = nbformat.read(executed if executed.exists() else path, as_version=4)
        text, pictures = _page(notebook, path.name)
        files.append(File.generated(config, f"{_FOLDER}/{path.stem}.md", content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"{_FOLDER}/{name}", content=content))
    return files


def _page(notebook: Any, name: str) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and its pictures by file name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    source = f"*This page shows the notebook `notebooks/{name}`.*"
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            if len(parts) == 1:
                parts.append(source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                picture = f"{Path(name).stem}_{len(pictures) + 1}.png"
                pictures[picture] = base64.b64decode(data["image/png"])
                parts.append(f"![Picture {len(pictures)} of this notebook]({picture})")
            elif printed := output.get("text") or data.get("text/plain"):
                parts.append(f"```text\n{printed.rstrip()}\n```")
    return "\n\n".join(parts) + "\n", pictures
