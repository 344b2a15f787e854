"""The scatter of neighbouring returns: nothing on planes, and the range noise that was put in."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from lio_jax.core.types import Scan, initial_nav_state
from lio_jax.lidar.params import ScanConfig
from lio_jax.lidar.range_scatter import range_scatter
from lio_jax.run.scan_inputs import padded
from lio_jax.tuning.objectives import _SHARPNESS, Observed, TruePose, range_noise
from tests.lidar.ring_scans import on_device, real_scans
from tests.params import default_params
from tests.shared_data import needs_shared

PARAMS = default_params()
_scatter = jax.jit(range_scatter)


def corridor(sigma=0.0, jitter=0.0, poles=0, seed=0, rings=32, columns=1024, order="columns") -> Scan:
    """Cast into a corridor of 8 x 5 x 60 m, askew in it, with poles that leave jumps of range."""
    rng = np.random.default_rng(seed)
    turn = 2 * np.pi * np.arange(columns) / columns
    up = np.radians(np.linspace(-22, 22, rings))
    turn, up = (each.ravel() for each in np.meshgrid(turn, up, indexing="ij"))
    beams = np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], 1)
    around = jaxlie.SO3.from_rpy_radians(0.05, -0.08, 0.4).as_matrix()
    askew = turn + jitter * rng.normal(size=len(turn)) / np.cos(up)
    shaken = np.stack([np.cos(up) * np.cos(askew), np.cos(up) * np.sin(askew), np.sin(up)], 1)
    rays = shaken @ np.asarray(around).T
    ahead = np.array([30.0, 4.0, 3.0]), np.array([30.0, 4.0, 2.0])
    distance = np.min(np.where(rays > 0, ahead[0], ahead[1]) / np.maximum(np.abs(rays), 1e-9), 1)
    for place in rng.uniform(0, 2 * np.pi, poles):
        distance = np.where(np.abs(turn - place) < 0.01, np.minimum(distance, 2.5), distance)
    distance = distance + sigma * rng.normal(size=len(distance))
    ring = np.tile(np.arange(rings), columns)
    kept = rng.uniform(size=len(ring)) < 0.97
    rows = np.flatnonzero(kept)
    if order == "rings":
        rows = rows[np.argsort(ring[rows], kind="stable")]
    n = rows.size + 100
    points, numbers = np.zeros((n, 3), np.float32), np.zeros(n, np.int32)
    points[: rows.size], numbers[: rows.size] = (beams * distance[:, None])[rows], ring[rows]
    zeros = jnp.zeros(n, jnp.float32)
    mask = jnp.arange(n) < rows.size
    return Scan(
        jnp.asarray(points), zeros, jnp.asarray(numbers), zeros, mask, jnp.float32(0.1), jnp.float32(0.1)
    )


def values(scan: Scan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    found = _scatter(scan, PARAMS.lidar)
    valid = np.asarray(found.valid)
    return tuple(np.asarray(part)[valid] for part in (found.deviation, found.spread, found.slope))


def test_planes_have_no_scatter_of_their_own():
    deviation, spread, _ = values(corridor())
    # the beams of a ring lie on a cone, not in a plane; what is beyond are the corridor's edges
    assert np.quantile(np.abs(deviation), 0.95) < 3e-4
    assert len(deviation) > 7000
    assert np.all(spread > 1)


@pytest.mark.parametrize("order", ["columns", "rings"])
def test_deviations_are_as_wide_as_the_range_noise_makes_them(order):
    deviation, spread, _ = values(corridor(0.02, order=order))
    assert 1.4826 * np.median(np.abs(deviation / spread)) == pytest.approx(0.02, rel=0.03)


def test_deviations_are_as_wide_as_the_beams_noise_makes_them():
    deviation, _, slope = values(corridor(jitter=1e-4))
    oblique = np.abs(slope) > 2.0
    assert np.sum(oblique) > 1000
    assert 1.4826 * np.median(np.abs(deviation / slope)[oblique]) == pytest.approx(1e-4, rel=0.05)


def test_returns_out_of_range_and_padding_do_not_count():
    scan = corridor(0.02)
    limited = dataclasses.replace(PARAMS.lidar, min_range=jnp.array(5.0), max_range=jnp.array(12.0))
    found = _scatter(scan, limited)
    assert 0 < int(jnp.sum(found.valid)) < int(jnp.sum(_scatter(scan, PARAMS.lidar).valid))
    nothing = dataclasses.replace(scan, mask=jnp.zeros_like(scan.mask))
    found = _scatter(nothing, PARAMS.lidar)
    assert not found.valid.any()
    assert np.isfinite(np.asarray(found.deviation)).all()


def test_scores_of_normal_noise_vary_as_much_as_the_loss_curves():
    def mean(function):
        return quad(lambda z: function(z) * norm.pdf(z), -12, 12)[0]

    def score(z, log_sigma=0.0):
        """Return the derivative of the density over its norm by the logarithm of the noise."""
        squared = z * z * np.exp(-2 * log_sigma)
        return np.exp(-squared / 2 - log_sigma / 2) * (squared - 0.5)

    density = mean(lambda z: np.exp(-z * z / 2))
    assert mean(score) == pytest.approx(0, abs=1e-10)
    variance = mean(lambda z: score(z) ** 2) / density**2
    step = 1e-4
    curvature = -(mean(lambda z: score(z, step)) - mean(lambda z: score(z, -step))) / (2 * step) / density
    assert pytest.approx(curvature / variance, rel=1e-6) == _SHARPNESS


@pytest.mark.parametrize("sigma", [0.005, 0.02, 0.08])
@pytest.mark.parametrize("start", [0.1, 10.0])
@pytest.mark.parametrize("poles", [20, 300])
def test_the_range_noise_is_found_among_poles(sigma, start, poles):
    """With 300 poles a third of the residuals are those of edges."""
    nav, scan = initial_nav_state(jaxlie.SE3.identity()), corridor(sigma, poles=poles, rings=64)
    truth = TruePose(jaxlie.SE3.identity(), jnp.array(False))

    @jax.jit
    def slope_and_curvature(logarithm):
        def loss(logarithm):
            lidar = dataclasses.replace(PARAMS.lidar, range_sigma=jnp.exp(logarithm))
            seen = Observed(
                nav, jnp.array(0.1), jnp.array(1e-6), jnp.int32(0), jnp.array(False), None, None, None
            )
            return range_noise(seen.with_scan(scan, dataclasses.replace(PARAMS, lidar=lidar)), truth)

        return jax.grad(loss)(logarithm), jax.hessian(loss)(logarithm)

    logarithm = np.log(sigma * start)
    for _ in range(40):
        slope, curvature = slope_and_curvature(jnp.asarray(logarithm))
        logarithm -= np.clip(float(slope) / max(float(curvature), 1.0), -0.5, 0.5)
    assert abs(float(slope)) < 1
    assert np.exp(logarithm) == pytest.approx(sigma, rel=0.03)


@needs_shared
@pytest.mark.parametrize("name", ["kitti_odometry_04", "kitti_raw_0005", "kitti_raw_0060", "ouster_os1_128"])
def test_recorded_returns_scatter_by_about_a_centimetre(name):
    scan, _ = next(real_scans(name))
    deviation, spread, _ = values(on_device(padded(scan, None, ScanConfig())))
    assert len(deviation) > 1000
    assert 0.005 < 1.4826 * np.median(np.abs(deviation / spread)) < 0.02
