"""How a solve ended: one set of codes for the scan matches, the filter, the smoother and their reports."""

CONVERGED = 0
ITERATION_LIMIT = 1
"""The last iterate was kept; derivatives there are not to be trusted."""
LOST = 2
"""The measurement was of no use, such as a scan with too few matches: the result is the prediction."""
NOT_FINITE = 3
"""Numbers overflowed: the result is the prediction, or the last states that were finite."""
