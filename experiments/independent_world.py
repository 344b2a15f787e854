"""Simulate a street by meshes and Embree, independently of ``lio_jax.sim``, and write a native recording.

    python experiments/independent_world.py --out DIR [--seed 0] [--seconds 20] [--beams 32 | 16]
        [--motion vehicle | handheld] [--start rest | moving] [--imu-rate 200] [--gyro-noise 1e-3]
        [--accel-noise 1e-2] [--gyro-walk 0] [--accel-walk 0] [--range-sigma 0.02] [--dropouts 0.03]

It needs trimesh and embreex, which the extra ``dev`` installs. ``lio-jax run DIR`` runs on the result.
"""

import argparse
from pathlib import Path


def main() -> None:
    """Write the recording."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--beams", type=int, choices=[16, 32], default=32)
    parser.add_argument("--motion", choices=["vehicle", "handheld"], default="vehicle")
    parser.add_argument("--start", choices=["rest", "moving"], default="rest")
    parser.add_argument("--imu-rate", type=float, default=200.0, help="Hz")
    parser.add_argument("--gyro-noise", type=float, default=1e-3, help="density, rad/s/sqrt(Hz)")
    parser.add_argument("--accel-noise", type=float, default=1e-2, help="density, m/s^2/sqrt(Hz)")
    parser.add_argument("--gyro-walk", type=float, default=0.0, help="density, rad/s^2/sqrt(Hz)")
    parser.add_argument("--accel-walk", type=float, default=0.0, help="density, m/s^3/sqrt(Hz)")
    parser.add_argument("--range-sigma", type=float, default=0.02, help="m")
    parser.add_argument("--dropouts", type=float, default=0.03, help="share of the returns")
    parser.add_argument("--overwrite", action="store_true")
    options = parser.parse_args()
    from independent.recording import Recording
    from independent.sensors import Imu, Lidar

    recording = Recording(
        options.seed,
        options.seconds,
        options.motion,
        options.start,
        Lidar(options.beams, range_sigma=options.range_sigma, dropouts=options.dropouts),
        Imu(
            options.imu_rate,
            options.gyro_noise,
            options.accel_noise,
            options.gyro_walk,
            options.accel_walk,
        ),
    )
    scans = recording.write(options.out, options.overwrite)
    print(f"{options.out}: {scans} scans")


if __name__ == "__main__":
    main()
