"""Does a second lap add nothing new? Drives through the simulated city again and again.

    python experiments/bench/laps.py [--recipe lio_sam] [--seconds 260] [--seeds 11] [--beams 16]
        [--set path=value ...] [--json]

A lap of the city's route takes about 110 s. The table shows the error of the trajectory, the points that were
added to the map in each twenty seconds, and the median time per scan. ``--set config.lio_sam.keyframes=128``
and ``=2048`` show what it costs that keyframes without room on the device come back from the host.
"""

import argparse
import json

import numpy as np

from lio_jax.data.trajectory import Trajectory

_PART = 200
"""Number of scans of which the added points are counted together."""


def main() -> None:
    """Run the laps and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recipe", default="lio_sam")
    parser.add_argument("--seconds", type=float, default=260.0)
    parser.add_argument("--seeds", nargs="+", type=int, default=[11])
    parser.add_argument("--beams", type=int, default=16)
    parser.add_argument("--set", nargs="*", default=[], dest="overrides", metavar="PATH=VALUE")
    parser.add_argument("--json", action="store_true", help="one JSON object on the last line")
    options = parser.parse_args()
    from lio_jax.commands.runtime import prepare_jax

    prepare_jax()
    from lio_jax import ImuModel, SimulatedSequence, evaluate, recipe_settings, with_overrides
    from lio_jax.run.run import imu_feed, settings_for
    from lio_jax.run.track import track

    rows = []
    print(f"{'seed':>4}{'ATE m':>9}{'ms':>7}  points added in each {_PART} scans")
    for seed in options.seeds:
        drive = SimulatedSequence(
            "city", duration_s=options.seconds, seed=seed, imu=ImuModel(), beams=options.beams, columns=512
        )
        settings, _ = settings_for(drive, with_overrides(recipe_settings(options.recipe), options.overrides))
        stamps, poses, added, step_ms = [], [], [], []
        for result in track(settings, drive.scans(), imu_feed(drive, settings)[0]):
            stamps.append(result.stamp_ns)
            poses.append(result.T_world_imu)
            added.append(int(np.count_nonzero(result.output.added)))
            step_ms.append(result.stage_ms["step"])
        row = {
            "seed": seed,
            "ate_m": evaluate(Trajectory(np.array(stamps), np.array(poses)), drive.truth()).ate.rmse,
            "median_ms": float(np.median(step_ms)),
            "added": [sum(added[start : start + _PART]) for start in range(0, len(added), _PART)],
        }
        rows.append(row)
        print(f"{seed:4}{row['ate_m']:9.4f}{row['median_ms']:7.1f}  {row['added']}", flush=True)
    if options.json:
        print(json.dumps({"recipe": options.recipe, "rows": rows}))


if __name__ == "__main__":
    main()
