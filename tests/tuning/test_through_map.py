"""Gradients through the map, against central differences of whole runs in which nothing is held.

The runs are in double precision, the map included, and the steps are so small that no point changes its
plane, nor its cell, unless it lies on the cell's edge.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.mapping import feature_map, point_map, voxel_map
from lio_jax.recipes import RECIPES, fast_lio2, lidar_inertial, lidar_odometry, lio_sam, loam
from lio_jax.registration import scan_to_scan
from lio_jax.run.compiled import Compiled
from lio_jax.run.track import run_steps
from lio_jax.settings.settings import recipe_of
from lio_jax.tuning.gradient import wants_map
from lio_jax.tuning.objectives import Observed, objective_named
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.reverse import checkpointed_gradient
from lio_jax.tuning.streaming import streaming_gradient
from tests.tuning.recordings import TIGHT, DoubleRecording, drive, settings
from tests.tuning.test_streaming import Everything

# a capacity of its own: programs are kept by the config, and these have another map
WIDE = [*TIGHT, "config.map.capacity=16384"]
FREE = {
    "default": (
        "lidar.range_sigma",
        "lidar.surface_sigma",
        "lidar.*_offset",
        "lidar.range_scale",
        "registration.kernel",
        "extrinsics.*",
    ),
    "fast_lio2": ("lidar.range_sigma", "registration.information_scale", "extrinsics.*"),
    "lio_sam": ("lidar.range_sigma", "knn.distance_weight", "lidar.elevation_offset", "extrinsics.*"),
    "loam": ("registration.kernel", "lidar.range_offset", "extrinsics.translation"),
}
SCANS = 8


def _with_double_maps(monkeypatch):
    makers = [
        (lidar_inertial, voxel_map.empty_map),
        (lidar_odometry, voxel_map.empty_map),
        (fast_lio2, point_map.empty_map),
        (lio_sam, feature_map.empty_feature_map),
        (loam, feature_map.empty_feature_map),
        (loam, scan_to_scan.empty_scan),
    ]
    for module, maker in makers:
        monkeypatch.setattr(module, maker.__name__, partial(maker, dtype=jnp.float64))


def total(chosen, params, recording):
    """Return the objective of a run, and which points each scan added to the map."""
    own, objective, sums, added = Compiled(recipe_of(chosen), params), Everything(), jnp.zeros(()), []
    for fed, state, output in run_steps(own, recording.scan_inputs()):
        sums = objective.add(sums, Observed.of(state, output), recording.truth_at(fed.end_ns))
        added.append(np.asarray(output.added))
    return float(sums), np.concatenate(added)


def check_gradients_through_the_map(recipe, inertial, monkeypatch):
    """Compare the derivative of a run by a recipe's ``FREE`` values with central differences."""
    _with_double_maps(monkeypatch)
    # a direction that the matches leave open is held, which the derivative takes as a choice: the few
    # features of the small street leave one open
    features = recipe == "lio_sam"
    sequence = drive("city", 32, 512) if features else drive()
    larger = ["config.lidar.buckets=[16384]"] * features
    chosen = settings(recipe, inertial, *WIDE, *larger, of=sequence)
    recording = DoubleRecording(sequence, chosen, 0, SCANS)
    patterns = [*FREE[recipe], *["imu.*_noise"][:inertial]]
    free = free_parameters(chosen.params(), patterns)
    x = np.asarray(free.first())
    about = recipe_of(chosen), free, Everything(), jnp.asarray(x), recording
    result = streaming_gradient(*about, through_map=True)
    assert not result.unconverged
    backward = checkpointed_gradient(*about, every=3, through_map=True)
    np.testing.assert_allclose(backward.gradient, result.gradient, rtol=1e-6, atol=1e-9)
    middle, kept = total(chosen, free(x), recording)
    for component, name in enumerate(free.names):
        # what turns beams or scales ranges moves far points most
        far = any(word in name for word in ("elevation", "rotation", "scale"))
        step = 5e-9 if far else 1e-7 if name.startswith("extrinsics") else 1e-6
        if features and name.startswith("imu"):
            # the smoother's noise moves poses so little that a small step drowns in rounding
            step = 1e-4
        ends = []
        for sign in (1, -1):
            moved = free(x + sign * step * (np.arange(len(x)) == component))
            value, added = total(chosen, moved, recording)
            # a point that lies on the edge of its cell changes it however small the step is
            if np.array_equal(added, kept):
                ends.append((sign * step, value))
        assert ends, f"both steps by {name} change which points the map keeps"
        (first, high), (last, low) = ends if len(ends) == 2 else [*ends, (0.0, middle)]
        difference = (high - low) / (first - last)
        assert result.gradient[component] == pytest.approx(difference, rel=1e-4, abs=2e-10 / step), name
    if not features:
        # the test would see a map that is held: by the lever arm its derivative is several times too large
        still = streaming_gradient(*about)
        arms = [component for component, name in enumerate(free.names) if "extrinsics.translation" in name]
        assert np.all(np.abs(still.gradient[arms]) > 3 * np.abs(result.gradient[arms]))


@pytest.mark.long
@pytest.mark.parametrize("inertial", [True, False])
def test_gradients_through_the_map_agree_with_differences_of_whole_runs(inertial, monkeypatch):
    check_gradients_through_the_map("default", inertial, monkeypatch)


def test_a_gradient_goes_through_the_map_where_that_matters():
    def wants(objective, *patterns):
        return wants_map(
            objective_named(objective), free_parameters(RECIPES["default"].params_type(), patterns)
        )

    assert wants("ate", "imu.*_noise")
    assert wants("map", "extrinsics.*")
    assert wants("ate+0.01*pose", "imu.*_noise")
    assert wants("noise", "imu.*_noise", "extrinsics.*")
    assert wants("noise", "lidar.elevation_offset")
    assert not wants("noise", "imu.*_noise", "lidar.range_sigma")
