"""Cost of a gradient compared with the plain run: time per scan, and memory over the recording's length.

python experiments/bench/gradient_cost.py [--scans N] [--through-map] [--memory] [--json]
python experiments/bench/gradient_cost.py --params '*' 'lidar.ring_*' --rings 1               # 24 parameters
python experiments/bench/gradient_cost.py --params 'lidar.ring_*' --rings 500 --mode reverse    # 1,000
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
    parser.add_argument("--params", nargs="+", default=PARAMETERS, help="names or globs")
    parser.add_argument("--rings", type=int, default=32, help="numbers of a parameter that has one per ring")
    parser.add_argument("--mode", choices=("forward", "reverse"), default="forward")
    parser.add_argument("--through-map", action="store_true", help="the map moves with the parameters")
    parser.add_argument("--memory", action="store_true", help="also run ten times as long and compare memory")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    prepare_jax()
    result = measured(options, options.scans, keep=not options.memory)
    print(f"{'parameters':32s} {result['parameters']:10d}")
    for name in ("plain_ms", "gradient_ms", "ratio", "cpu_ratio"):
        print(f"{name:32s} {result[name]:10.2f}")
    if options.memory:
        longer = measured(options, 10 * options.scans, keep=False)
        result["peak_rss_mb"], result["peak_rss_10x_mb"] = result["rss_mb"], longer["rss_mb"]
        print(f"{'memory, MiB':32s} {result['peak_rss_mb']:10.0f}")
        print(f"{'memory, ten times as many scans':32s} {result['peak_rss_10x_mb']:10.0f}")
    if options.json:
        print(json.dumps(result))


def measured(options: argparse.Namespace, scans: int, keep: bool) -> dict[str, float]:
    """Return the times per scan of both, measured in one process.

    In forward mode and in the plain run it is the median over the scans; in reverse mode, which goes through
    the recording twice, it is the mean of a whole gradient. ``cpu_ratio`` is that of the CPU times, which
    other processes change less. Scans that are kept leave both cores to the steps; else they are simulated
    meanwhile, in constant memory.
    """
    from lio_jax import ImuModel, SimulatedSequence
    from lio_jax.run.compiled import CompiledStep
    from lio_jax.run.run import peak_rss_mb, settings_for
    from lio_jax.run.track import run_steps
    from lio_jax.settings.settings import recipe_of, recipe_settings
    from lio_jax.tuning.objectives import objective_named
    from lio_jax.tuning.parameters import free_parameters
    from lio_jax.tuning.recording import Recording
    from lio_jax.tuning.reverse import checkpointed_gradient
    from lio_jax.tuning.streaming import streaming_gradient

    class TimedRecording(Recording):
        """Record the time between the return of each scan and the request for the next one."""

        def scan_inputs(self):
            self.ms, self.cpu_ms = [], []
            for fed in super().scan_inputs():
                start, cpu = time.perf_counter(), time.process_time()
                yield fed
                self.ms.append((time.perf_counter() - start) * 1e3)
                self.cpu_ms.append((time.process_time() - cpu) * 1e3)

    sequence = SimulatedSequence("street", "generic32", scans * 0.1, seed=0, imu=ImuModel())
    settings, _ = settings_for(sequence, recipe_settings("default"))
    recording = TimedRecording(sequence, settings, keep=keep)
    free = free_parameters(settings.params(), options.params, lambda: options.rings)
    about = recipe_of(settings), free, objective_named("pose").objective, free.first(), recording
    if options.mode == "forward":
        streaming_gradient(*about, options.through_map)
        gradient_ms, cpu_ms = float(np.median(recording.ms[5:])), float(np.median(recording.cpu_ms[5:]))
    else:
        checkpointed_gradient(*about, through_map=options.through_map)
        start, cpu = time.perf_counter(), time.process_time()
        checkpointed_gradient(*about, through_map=options.through_map)
        gradient_ms = (time.perf_counter() - start) / len(recording) * 1e3
        cpu_ms = (time.process_time() - cpu) / len(recording) * 1e3
    for _, state, output in run_steps(CompiledStep(settings), recording.scan_inputs()):
        jax.block_until_ready((state.nav, output))
    plain_ms = float(np.median(recording.ms[5:]))
    return {
        "plain_ms": plain_ms,
        "gradient_ms": gradient_ms,
        "ratio": gradient_ms / plain_ms,
        "cpu_ratio": cpu_ms / float(np.median(recording.cpu_ms[5:])),
        "parameters": len(free.names),
        "rss_mb": peak_rss_mb(),
    }


if __name__ == "__main__":
    main()
