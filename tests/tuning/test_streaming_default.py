"""Streaming gradients of default against central differences, by every differentiable leaf."""

import pytest

from tests.tuning.test_streaming import BY_RECIPE, check_gradients


@pytest.mark.parametrize("inertial", BY_RECIPE["default"])
def test_gradients_of_every_leaf_agree_with_central_differences(inertial):
    check_gradients("default", inertial)
