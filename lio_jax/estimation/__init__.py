"""Estimation: the iterated error-state filter and its measurements."""
