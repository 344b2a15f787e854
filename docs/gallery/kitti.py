"""Draw the trajectory of a KITTI recording beside its truth.

``python docs/gallery/kitti.py RECORDING`` takes a drive of KITTI raw or a sequence of KITTI odometry.
"""

import jax
import numpy as np
from picture import ESTIMATE, TRUTH, canvas, legend_above, options, run, save
from scipy.spatial.transform import Rotation

from lio_jax import open_sequence


def main() -> None:
    given = options(__file__, "recording")
    jax.config.update("jax_enable_x64", True)
    sequence = open_sequence(given.recording)
    result = run(sequence)
    truth = sequence.truth().at(result.trajectory.stamp_ns)
    estimate = result.trajectory.at(truth.stamp_ns).positions
    # as for the absolute trajectory error: the rotation and translation of least squares
    rotation, _ = Rotation.align_vectors(
        estimate - estimate.mean(0), truth.positions - truth.positions.mean(0)
    )
    true = rotation.apply(truth.positions - truth.positions.mean(0)) + estimate.mean(0)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
    print(f"{way[-1]:.1f} m in {len(way)} scans")

    figure, (plan, error) = canvas(5.6, 2, height_ratios=(1.6, 1))
    plan.plot(*true[:, :2].T, color=TRUTH, lw=4, label="truth")
    plan.plot(*estimate[:, :2].T, color=ESTIMATE, lw=2, label="estimate")
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    legend_above(plan, 2)
    for axis, name, colour in zip(range(3), "xyz", ("tab:red", "tab:green", "tab:purple"), strict=True):
        error.plot(way, 100 * (estimate - true)[:, axis], color=colour, lw=2, label=name)
    error.set(xlabel="way [m]", ylabel="difference [cm]")
    legend_above(error, 3)
    save(figure, given.out)


if __name__ == "__main__":
    main()
