"""Gradients of lio_sam through its map, against central differences of whole runs."""

import pytest

from tests.tuning.test_through_map import check_gradients_through_the_map


@pytest.mark.long
def test_gradients_through_the_map_agree_with_differences_of_whole_runs(monkeypatch):
    check_gradients_through_the_map("lio_sam", True, monkeypatch)
