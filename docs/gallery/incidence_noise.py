"""Learn how the noise of the ranges grows with the angle of incidence, and draw it with the noise put in."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from picture import ESTIMATE, TRUTH, canvas, legend_above, options, save
from scipy.optimize import minimize

from lio_jax import (
    CompiledStep,
    Frame,
    ImuModel,
    SimulatedSequence,
    anchor_of,
    associate,
    deskew_along,
    imu_feed,
    lidar_pose,
    path_along,
    recipe_settings,
    run_steps,
    scan_inputs,
    settings_for,
)
from lio_jax.lidar.range_scatter import range_scatter
from lio_jax.sim.lidar import spinning_lidar

KNOTS = np.radians(np.arange(0, 91, 10))
"""Angles at which the noise is a parameter, rad; it is linear between them."""
SCALE = 0.612
"""Scale of the Cauchy density that fits normal noise of standard deviation 1 best."""
COLUMNS = 1024


def true_sigma(incidence):
    """Return the standard deviation of a range, m, as it is put in."""
    return 0.01 + 0.04 * np.sin(incidence) ** 4


class NoisyAtGrazing(SimulatedSequence):
    """A drive whose exact ranges get noise by the angle at which the beam meets the surface."""

    def scans(self, start=0, count=None):
        for number, scan in enumerate(super().scans(start, count), start):
            grid = np.full((self.lidar.beams, COLUMNS + 1, 3), np.nan)
            column = np.round(scan.time * COLUMNS / scan.duration).astype(int)
            grid[scan.ring, column] = scan.points
            normal = np.cross(np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1])
            normal = np.concatenate([normal, normal[-1:]])[scan.ring, column]
            distance = np.linalg.norm(scan.points, axis=1)
            cosine = np.abs(np.sum(normal * scan.points, axis=1)) / distance / np.linalg.norm(normal, axis=1)
            kept = np.isfinite(cosine) & (distance > 2.0) & (distance < 60.0)
            sigma = true_sigma(np.arccos(np.clip(cosine[kept], 0, 1)))
            noise = sigma * np.random.default_rng(number).standard_normal(kept.sum())
            points = scan.points[kept] * (1 + noise / distance[kept])[:, None]
            columns = {name: getattr(scan, name)[kept] for name in ("time", "ring", "intensity")}
            yield replace(scan, points=points.astype(np.float32), **columns)


@jax.jit
def residuals(params, before, nav, vmap, scan, imu):
    """Return range residuals of a scan, m, their scale, the angles of incidence, and which of them count."""
    path = path_along(before, imu, start=scan.duration - scan.interval, end=scan.duration)
    points = deskew_along(path, nav.T_imu_lidar, scan.points, scan.time)
    T = lidar_pose(nav)
    frame = Frame(*anchor_of(T.translation(), params.map.voxel_size))
    planes = associate(vmap, points, scan.mask, T, frame, params.map)
    beam = points @ T.rotation().as_matrix().T.astype(points.dtype)
    cosine = jnp.abs(jnp.sum(beam * planes.normal, -1)) / jnp.linalg.norm(points, axis=-1)
    flat = planes.used & (planes.variances[:, 0] < 0.05 * planes.variances[:, 1])
    scatter = range_scatter(scan, params.lidar)
    middle = jnp.argsort(jnp.where(scan.mask, scan.ring, 2**30), stable=True)[1::3][: len(scatter.valid)]
    angle = jnp.arccos(jnp.clip(cosine[middle], 0.0, 1.0))
    return scatter.deviation, scatter.spread, angle, scatter.valid & flat[middle]


def main() -> None:
    out = options(__file__).out
    jax.config.update("jax_enable_x64", True)
    sensor = spinning_lidar(32, COLUMNS, range_sigma=0.0)
    drive = NoisyAtGrazing("street", sensor, duration_s=8.0, imu=ImuModel(), moving_start=True)
    settings, _ = settings_for(drive, recipe_settings("default"))
    step, found, before = CompiledStep(settings), [], None
    for fed, state, _ in run_steps(step, scan_inputs(settings, drive.scans(), imu_feed(drive, settings)[0])):
        if fed.index >= 20:  # the map has planes by now
            *values, valid = residuals(step.params, before, state.nav, state.map, fed.scan, fed.imu)
            found.append([np.asarray(value)[np.asarray(valid)] for value in values])
        before = jax.tree.map(jnp.copy, state.nav)
    deviation, spread, angle = (jnp.asarray(np.concatenate(part)) for part in zip(*found, strict=True))

    @jax.jit
    @jax.value_and_grad
    def loss(log_sigma):
        scale = SCALE * spread * jnp.exp(jnp.interp(angle, KNOTS, log_sigma))
        return jnp.mean(jnp.log(scale) + jnp.log1p((deviation / scale) ** 2))

    start = np.full(len(KNOTS), np.log(0.03))
    learned = np.exp(minimize(lambda x: [np.asarray(one) for one in loss(x)], start, jac=True).x)
    print(f"{len(angle)} residuals; learned / true: {(learned / true_sigma(KNOTS)).round(2)}")

    figure, (axes,) = canvas(3.8)
    fine = np.linspace(0, np.pi / 2, 200)
    axes.plot(np.degrees(fine), 100 * true_sigma(fine), color=TRUTH, lw=2, label="put in")
    axes.plot(np.degrees(KNOTS), 100 * np.exp(start), "--", color="0.5", label="start")
    axes.plot(np.degrees(KNOTS), 100 * learned, "o-", color=ESTIMATE, lw=2, label="learned")
    axes.set(xlabel="angle of incidence [deg]", ylabel="noise of a range [cm]", ylim=(0, None))
    legend_above(axes, 3)
    save(figure, out)


if __name__ == "__main__":
    main()
