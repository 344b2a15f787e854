"""``lio-jax eval``: compare a trajectory with a reference."""

import json
from pathlib import Path

from lio_jax.evaluation.evaluate import evaluate_files, format_evaluation


def evaluate(estimate: Path, reference: Path, as_json: bool) -> None:
    """Print the errors as a table, or as one JSON object."""
    evaluation = evaluate_files(estimate, reference)
    print(json.dumps(evaluation.as_dict(), allow_nan=False) if as_json else format_evaluation(evaluation))
