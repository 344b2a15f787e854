"""``lio-jax demo``: simulate a street, run on it, compare with the truth."""

from pathlib import Path

from lio_jax.commands.run import run_and_report
from lio_jax.commands.runtime import say
from lio_jax.core.settings import Settings
from lio_jax.sim.sequence import SimulatedSequence


def demo(out: Path, overwrite: bool) -> None:
    """Run the default recipe on ten simulated seconds of driving."""
    sequence = SimulatedSequence(world="street", duration_s=10.0)
    say("simulating and tracking a 32-beam LiDAR on ten seconds of a street ...")
    run_and_report(sequence, Settings(), out, 0, None, sequence.truth(), overwrite)
