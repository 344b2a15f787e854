"""Each picture of the gallery exists, and the command under it makes it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import pytest

from tests.shared_data import SHARED_DATA

ROOT = Path(__file__).parents[2]
GALLERY = ROOT / "docs" / "gallery"
DRIVE = SHARED_DATA / "kitti_raw" / "2011_09_26" / "2011_09_26_drive_0005_sync"
SHARED, RECORDED = "picture", "kitti"
"""Names of the module that the scripts share, and of the script that needs a recording."""
MOST_BYTES = 150_000


def sections() -> dict[str, str]:
    """Return the text of each picture's section by the name of the picture."""
    parts = (GALLERY.parent / "gallery.md").read_text().split("\n## ")[1:]
    named = [(re.findall(r"!\[[^\]]+\]\(gallery/(\w+)\.png\)", part), part) for part in parts]
    assert [part.splitlines()[0] for names, part in named if len(names) != 1] == []
    return {names[0]: part for names, part in named}


def test_every_picture_has_a_script_and_its_command():
    found = sections()
    assert len(found) == 11
    assert set(found) == {path.stem for path in GALLERY.glob("*.py")} - {SHARED}
    assert set(found) == {path.stem for path in GALLERY.glob("*.png")}
    for name, part in found.items():
        command = f"python docs/gallery/{name}.py" + f" {DRIVE.name}" * (name == RECORDED)
        assert re.findall(r"^```bash\n(.+)\n```$", part, re.MULTILINE) == [command]
        assert part.index("![") < part.index(command)


@pytest.mark.parametrize("name", [path.stem for path in sorted(GALLERY.glob("*.png"))])
def test_a_picture_is_small_and_as_wide_as_a_page(name):
    assert (GALLERY / f"{name}.png").stat().st_size < MOST_BYTES
    assert matplotlib.image.imread(GALLERY / f"{name}.png").shape[1] == 696


@pytest.mark.long
@pytest.mark.parametrize("name", [path.stem for path in sorted(GALLERY.glob("*.py")) if path.stem != SHARED])
def test_a_script_draws_its_picture(name, tmp_path):
    if name == RECORDED and not DRIVE.is_dir():
        pytest.skip(f"{DRIVE} is not here: the picture of a recording is not drawn")
    drawn = tmp_path / f"{name}.png"
    words = [f"docs/gallery/{name}.py", *[str(DRIVE)] * (name == RECORDED), "--out", str(drawn)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr
    shown = matplotlib.image.imread(GALLERY / f"{name}.png")
    assert matplotlib.image.imread(drawn).shape == shown.shape
