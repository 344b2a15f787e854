"""``lio-jax view``: open a run's recording."""

from pathlib import Path

from lio_jax.commands.runtime import say
from lio_jax.core.errors import UsageError
from lio_jax.viz.viewer import served, show


def view(path: Path, web: bool) -> None:
    """Show a run folder or an .rrd file in a window, or serve it to a browser until Ctrl-C."""
    recording = path / "recording.rrd" if path.is_dir() else path
    if not recording.is_file():
        raise UsageError(f"{recording}: is not there; give a folder that lio-jax run wrote, or an .rrd.")
    if not web:
        show(recording)
        return
    with served(recording) as server:
        say(f"open {server.page}\nCtrl-C ends it.")
        try:
            server.process.wait()
        except KeyboardInterrupt:
            return
