"""Estimation: the iterated error-state filter and its measurements, and the smoother of a chain of states."""
