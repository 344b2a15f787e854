"""Finer voxels where the surroundings are near, and only where nobody chose."""

import numpy as np
import pytest

from lio_jax.core.settings import recipe_settings, with_overrides
from lio_jax.run.surroundings import NEAR_VALUES, fitted_to_surroundings
from tests.run.small_drive import Replay, moving


class At(Replay):
    """A drive whose scans are scaled so that the median range is what it is told; some may be empty."""

    def __init__(self, median, empty=0):
        super().__init__(moving())
        self.median, self.empty = median, empty

    def scans(self, start=0, count=None):
        import dataclasses

        for number, scan in enumerate(super().scans(start, count)):
            scale = self.median / np.median(np.linalg.norm(scan.points, axis=1))
            points = (scale * scan.points).astype(np.float32)
            points[0] = np.nan
            kept = slice(0, 0) if number < self.empty else slice(None)
            rows = {
                name: value[kept]
                for name, value in (("points", points), ("time", scan.time), ("ring", scan.ring))
                if value is not None
            }
            if scan.intensity is not None:
                rows["intensity"] = scan.intensity[kept]
            yield dataclasses.replace(scan, **rows)


def values(settings):
    params = settings.params()
    paths = (path.split(".")[1:] for path in NEAR_VALUES)
    return [float(getattr(getattr(params, section), name)) for section, name in paths]


@pytest.mark.parametrize(("median", "near"), [(1.5, True), (4.9, True), (5.1, False), (12.0, False)])
def test_voxels_are_fine_where_the_surroundings_are_near(median, near):
    settings = recipe_settings("default")
    fitted, notes = fitted_to_surroundings(At(median), settings)
    assert values(fitted) == pytest.approx(list(NEAR_VALUES.values()) if near else values(settings))
    assert len(notes) == near
    if near:
        assert f"median range {median:.1f} m" in notes[0]


def test_an_empty_first_scan_does_not_decide():
    assert fitted_to_surroundings(At(2.0, empty=2), recipe_settings("default"))[1]
    assert not fitted_to_surroundings(At(2.0, empty=3), recipe_settings("default"))[1]


def test_what_was_given_stays():
    given = with_overrides(recipe_settings("default"), ("params.map.voxel_size=0.8",))
    fitted, notes = fitted_to_surroundings(At(2.0), given)
    assert float(fitted.params().map.voxel_size) == pytest.approx(0.8)
    assert float(fitted.params().lidar.min_range) == pytest.approx(0.5)
    assert "voxel_size 0.4" not in notes[0]


def test_other_recipes_keep_their_systems_values():
    settings = recipe_settings("fast_lio2")
    assert fitted_to_surroundings(At(2.0), settings) == (settings, [])
