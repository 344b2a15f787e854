"""Cost of a gradient compared with the plain run: time per scan, and memory over the recording's length.

python experiments/bench/gradient_cost.py [--scans N] [--through-map] [--memory] [--json]
"""

import argparse
import json
import time

import jax
import numpy as np

from lio_jax.commands.runtime import prepare_jax

PARAMETERS = (
    "imu.*_noise",
    "imu.*_walk",
    "initial.velocity_sigma",
    "initial.gyro_bias_sigma",
    "initial.accel_bias_sigma",
    "lidar.range_sigma",
    "registration.information_scale",
    "extrinsics.translation",
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--through-map", action="store_true", help="the map moves with the parameters")
    parser.add_argument("--memory", action="store_true", help="also run ten times as long and compare memory")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    prepare_jax()
    result = measured(options.scans, options.through_map, keep=not options.memory)
    print(f"{'parameters':32s} {result['parameters']:10d}")
    for name in ("plain_ms", "gradient_ms", "ratio"):
        print(f"{name:32s} {result[name]:10.2f}")
    if options.memory:
        longer = measured(10 * options.scans, options.through_map, keep=False)
        result["peak_rss_mb"], result["peak_rss_10x_mb"] = result["rss_mb"], longer["rss_mb"]
        print(f"{'memory, MiB':32s} {result['peak_rss_mb']:10.0f}")
        print(f"{'memory, ten times as many scans':32s} {result['peak_rss_10x_mb']:10.0f}")
    if options.json:
        print(json.dumps(result))


def measured(scans: int, through_map: bool, keep: bool) -> dict[str, float]:
    """Return the median times per scan of both, measured in one process.

    Scans that are kept leave both cores to the steps; else they are simulated meanwhile, in constant memory.
    """
    from lio_jax import ImuModel, SimulatedSequence
    from lio_jax.run.run import peak_rss_mb, settings_for
    from lio_jax.run.track import CompiledStep, run_steps
    from lio_jax.settings.settings import recipe_of, recipe_settings
    from lio_jax.tuning.objectives import objective_named
    from lio_jax.tuning.parameters import free_parameters
    from lio_jax.tuning.recording import Recording
    from lio_jax.tuning.streaming import streaming_gradient

    class TimedRecording(Recording):
        """Record the time between the return of each scan and the request for the next one."""

        def scan_inputs(self):
            self.ms = []
            for fed in super().scan_inputs():
                start = time.perf_counter()
                yield fed
                self.ms.append((time.perf_counter() - start) * 1e3)

    sequence = SimulatedSequence("street", "generic32", scans * 0.1, seed=0, imu=ImuModel())
    settings, _ = settings_for(sequence, recipe_settings("default"))
    recording = TimedRecording(sequence, settings, keep=keep)
    free = free_parameters(settings.params(), PARAMETERS)
    pose = objective_named("pose").objective
    streaming_gradient(recipe_of(settings), free, pose, free.first(), recording, through_map)
    gradient_ms = float(np.median(recording.ms[5:]))
    for _, state, output in run_steps(CompiledStep(settings), recording.scan_inputs()):
        jax.block_until_ready((state.nav, output))
    plain_ms = float(np.median(recording.ms[5:]))
    return {
        "plain_ms": plain_ms,
        "gradient_ms": gradient_ms,
        "ratio": gradient_ms / plain_ms,
        "parameters": len(free.names),
        "rss_mb": peak_rss_mb(),
    }


if __name__ == "__main__":
    main()
