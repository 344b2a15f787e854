"""The table of derivatives and slopes, and what its draws change."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from lio_jax.recipes import RECIPES
from lio_jax.tuning.parameters import free_parameters
from tests.run.small_drive import moving, write_folder

sys.path.append(str(Path(__file__).parents[2] / "experiments"))

from gradient_check import with_other_cubes  # isort: skip

ROOT = Path(__file__).parents[2]


@pytest.mark.long
def test_derivative_and_slope_agree_where_choices_have_no_part(tmp_path):
    recording = write_folder(tmp_path / "drive", moving())
    words = ("--objective", "ranges", "--params", "lidar.range_sigma", "--widths", "0.1", "--draws", "3")
    done = subprocess.run(
        [sys.executable, str(ROOT / "experiments" / "gradient_check.py"), str(recording), *words],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    header, row = done.stdout.splitlines()[-2:]
    # the first column is called "by"; "off by" is one column
    assert header.replace("off by", "off").split()[6] == "ratio"
    assert float(row.split()[6]) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_draw_changes_the_edges_of_cubes_alone(recipe):
    free = free_parameters(RECIPES[recipe].params_type(), ["lidar.range_*"])
    other = with_other_cubes(free, np.random.default_rng(0))
    leaves = zip(jax.tree_util.tree_leaves_with_path(free.start), jax.tree.leaves(other.start), strict=True)
    changed = {jax.tree_util.keystr(path) for (path, old), new in leaves if not np.array_equal(old, new)}
    assert {".map.voxel_size", ".map.point_spacing"} <= changed
    assert all(path.endswith(("spacing", "voxel_size")) for path in changed)
    np.testing.assert_array_equal(other.first(), free.first())
