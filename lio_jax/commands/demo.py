"""``lio-jax demo``: simulate a drive through a city, run on it, compare with the truth."""

from pathlib import Path

from lio_jax.commands.run import run_and_report
from lio_jax.commands.runtime import say
from lio_jax.settings.settings import Settings
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence


def demo(out: Path, overwrite: bool) -> None:
    """Run the default recipe on twelve seconds of simulated driving."""
    sequence = SimulatedSequence(world="city", sensor="generic32", duration_s=12.0, imu=ImuModel())
    say("simulating and tracking a 32-beam LiDAR and an IMU on twelve seconds of a city ...")
    run_and_report(sequence, Settings(), out, 0, None, sequence.truth(), overwrite)
