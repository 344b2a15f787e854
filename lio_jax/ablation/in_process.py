"""A small ablation in the calling process: for a notebook, where worker processes are not worth starting."""

from pathlib import Path

from lio_jax.ablation.comparison import Comparison, compare
from lio_jax.ablation.perform import perform
from lio_jax.ablation.spec import load_spec
from lio_jax.ablation.store import opened
from lio_jax.ablation.tasks import pieces, tasks_of
from lio_jax.data.whole_output import disk_errors_said
from lio_jax.run.folder import write_text


def run_ablation(spec_path: Path, out: Path) -> Comparison:
    """Run what a specification asks for, one run after the other, and compare.

    As ``lio-jax ablate`` does it, but with JAX as the caller has set it up. What ``out`` holds already is not
    run again.

    Args:
        spec_path: YAML file; see :mod:`lio_jax.ablation.spec`.
        out: folder of the results, new or of an earlier ablation.

    Raises:
        UsageError: the specification is wrong, or the folder is taken.
        LioJaxError: nothing can be written any more.
    """
    spec = load_spec(spec_path)
    tasks = tasks_of(spec)
    with opened(out) as store:
        with disk_errors_said(out / "spec.yaml"):
            write_text(out / "spec.yaml", spec.text)
        for piece in pieces(tasks, 1):
            perform(piece, store)
        return compare(spec, tasks, store)
