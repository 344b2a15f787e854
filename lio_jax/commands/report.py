"""``lio-jax report``: draw a run's report again, or compare several runs on one page."""

from pathlib import Path

from lio_jax.core.errors import UsageError


def report(folders: tuple[Path, ...], out: Path | None) -> None:
    """Write the page and print where it is."""
    if not folders:
        raise UsageError("report: needs DIR [DIR ...]; --help explains the command.")
    if out is not None and out.is_dir():
        raise UsageError(f"{out}: is a folder; give a file such as {out / 'report.html'}.")
    if len(folders) == 1:
        from lio_jax.viz.report import write_report

        print(write_report(folders[0], out))
        return
    if out is None:
        raise UsageError("report: needs --out FILE.html to compare several runs.")
    from lio_jax.viz.compare import write_comparison

    write_comparison(folders, out)
    print(out)
