"""The names of the objectives of :mod:`lio_jax.tuning.objectives`, for help texts that must not load JAX."""

LIKELIHOODS = ("pose", "point", "marginal", "ranges")
"""Objectives that are mean negative log-likelihoods and need no truth."""
SINGLE = (*LIKELIHOODS, "map", "ate", "rpe", "rpe-rotation")
"""All objectives that are no sum of others."""
SHORT = {"noise": "pose+ranges"}
"""Sums with a name of their own."""
LISTED = ", ".join([*SHORT, *SINGLE])
"""All names in one line."""
EXAMPLE = "ate+0.01*pose"
"""A sum of objectives, as it is written."""
