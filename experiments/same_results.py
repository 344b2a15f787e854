"""Check that a change of the code keeps trajectories of all recipes and gradients, bit by bit.

python experiments/same_results.py keep DIR [--recordings DIR]      before the change
python experiments/same_results.py compare DIR [--recordings DIR]   after it

Runs every recipe on a simulated street. Where ``--recordings`` names a folder with ``kitti_odometry`` and
``kitti_raw``, also on odometry 04 and raw drive 0005. Computes gradients with respect to twelve parameters on
the street. A difference is printed as the largest distance between two poses, m, or as the largest relative
difference between two derivatives.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lio_jax.commands.runtime import prepare_jax

RECIPES = ("default", "fast_lio2", "loam", "lio_sam")
LONGEST = 40
"""Number of scans of a recording."""
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
OBJECTIVES = (("default", "noise"), ("default", "ate"), ("fast_lio2", "pose"), ("lio_sam", "marginal"))
RECORDINGS = {
    "kitti04": "kitti_odometry/sequences/04",
    "raw0005": "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync",
}


def main() -> None:
    """Keep the results, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("action", choices=("keep", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--only", default="", help="names that begin like this")
    options = parser.parse_args()
    prepare_jax()
    options.folder.mkdir(parents=True, exist_ok=True)
    different = 0
    for name, numbers in results(options.recordings, options.only):
        path = options.folder / f"{name}.npy"
        if options.action == "keep":
            np.save(path, numbers)
            print(f"{name:28s} kept", flush=True)
            continue
        kept = np.load(path, allow_pickle=False)
        alike = kept.shape == numbers.shape and np.array_equal(kept, numbers, equal_nan=True)
        different += not alike
        print(f"{name:28s} {'bit-identical' if alike else described(kept, numbers)}", flush=True)
    sys.exit(1 if different else 0)


def described(kept: np.ndarray, numbers: np.ndarray) -> str:
    """Return the difference between two results in words."""
    if kept.shape != numbers.shape:
        return f"differs: {kept.shape} before, {numbers.shape} now"
    if kept.ndim == 3:
        return f"differs: {np.abs(kept - numbers)[:, :3, 3].max():.3g} m"
    return f"differs: {(np.abs(kept - numbers) / np.maximum(np.abs(kept), 1e-12)).max():.3g} of its size"


def results(recordings: Path | None, only: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each result by name: poses (n, 4, 4), or value and gradient (1 + p,)."""
    from lio_jax import (
        ImuModel,
        SimulatedSequence,
        gradient,
        open_sequence,
        recipe_settings,
        run_sequence,
        settings_for,
    )

    street = SimulatedSequence("street", "generic32", 6.0, seed=3, imu=ImuModel())
    sequences = {"street": street}
    if recordings:
        sequences |= {
            name: open_sequence(recordings / path)
            for name, path in RECORDINGS.items()
            if (recordings / path).exists()
        }
    for where, sequence in sequences.items():
        for recipe in RECIPES:
            name = f"{where}_{recipe}"
            if name.startswith(only):
                if recipe == "lio_sam" and sequence.imu() is None:
                    continue
                settings, _ = settings_for(sequence, recipe_settings(recipe))
                with TemporaryDirectory() as out:
                    run = run_sequence(sequence, settings, Path(out), count=LONGEST)
                yield name, np.asarray(run.trajectory.poses)
    for recipe, objective in OBJECTIVES:
        name = f"gradient_{recipe}_{objective}"
        if name.startswith(only):
            found = gradient(street, PARAMETERS, objective, recipe_settings(recipe), count=30)
            yield name, np.array([found.value, *found.gradient.values()])


if __name__ == "__main__":
    main()
