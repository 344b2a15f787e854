"""Streaming gradients of fast_lio2 against central differences, by every differentiable leaf."""

import pytest

from tests.tuning.test_streaming import BY_RECIPE, check_gradients


@pytest.mark.long
@pytest.mark.parametrize("inertial", BY_RECIPE["fast_lio2"])
def test_gradients_of_every_leaf_agree_with_central_differences(inertial):
    check_gradients("fast_lio2", inertial)
