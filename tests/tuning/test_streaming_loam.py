"""Streaming gradients of loam against central differences, by every differentiable leaf."""

import pytest

from tests.tuning.test_streaming import BY_RECIPE, check_gradients


@pytest.mark.long
@pytest.mark.parametrize("inertial", BY_RECIPE["loam"])
def test_gradients_of_every_leaf_agree_with_central_differences(inertial):
    check_gradients("loam", inertial)
