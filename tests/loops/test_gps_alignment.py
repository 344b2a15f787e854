"""Yaw and place of the odometry's world from fixes, against known truth and general solvers."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from lio_jax.loops.gps import alignment
from tests.loops.drives import SHIFT, YAW, drive, to_enu

LOOSE = 10.0


def expected():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", YAW).as_matrix(), SHIFT
    return T


def yaw_of(found):
    return np.arctan2(found.T_enu_odom[1, 0], found.T_enu_odom[0, 0])


def antennas(length=100, every=5):
    return drive(length).antennas()[::every]


def round_covariances(count, sigma=1.0):
    return np.tile(sigma**2 * np.eye(3), (count, 1, 1))


@pytest.mark.parametrize("yaw", [-3.1, -1.0, 0.0, 1.57, 3.1415])
def test_exact_fixes(yaw):
    p = antennas()
    turn = Rotation.from_euler("z", yaw)
    found = alignment(p, turn.apply(p) + SHIFT, round_covariances(len(p)), 0.1)
    np.testing.assert_allclose(found.T_enu_odom[:3, :3], turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.T_enu_odom[:3, 3], SHIFT, atol=1e-9)
    assert found.inlier.all()


def test_the_optimum_is_scipys():
    """The covariances are anisotropic and differ from fix to fix."""
    rng = np.random.default_rng(0)
    p = antennas()
    root = rng.normal(size=(len(p), 3, 3)) + 2 * np.eye(3)
    covariances = root @ root.transpose(0, 2, 1)
    f = to_enu(p) + 0.5 * np.einsum("kij,kj->ki", root, rng.normal(size=p.shape))
    found = alignment(p, f, covariances, LOOSE)
    assert found.inlier.all()
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))

    def residual(x):
        return np.einsum("kij,kj->ki", whiten, Rotation.from_euler("z", x[0]).apply(p) + x[1:] - f).ravel()

    theirs = least_squares(residual, [YAW, *SHIFT], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert yaw_of(found) == pytest.approx(theirs.x[0], abs=1e-7)
    np.testing.assert_allclose(found.T_enu_odom[:3, 3], theirs.x[1:], atol=1e-5)


def test_covariance_is_what_repeated_noise_makes():
    """White noise of the stated size, and the estimates' own spread."""
    p = antennas(150)
    errors, sigmas = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        found = alignment(p, to_enu(p) + rng.normal(size=p.shape), round_covariances(len(p)), LOOSE)
        errors.append(np.r_[yaw_of(found) - YAW, found.T_enu_odom[:3, 3] - SHIFT])
        sigmas.append(found.covariance)
    errors, mean = np.array(errors), np.mean(sigmas, axis=0)
    nees = np.mean([e @ np.linalg.solve(mean, e) for e in errors])
    assert 2.0 < nees < 5.0
    assert np.std(errors[:, 0]) == pytest.approx(np.sqrt(mean[0, 0]), rel=0.35)


def test_errors_that_follow_each_other_say_less():
    """Multipath of half a minute: the stated covariance alone would promise far too much."""
    p = antennas(400)
    sigmas, errors = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        slow = np.zeros_like(p)
        for k in range(1, len(p)):
            slow[k] = 0.95 * slow[k - 1] + np.sqrt(1 - 0.95**2) * rng.normal(size=3)
        found = alignment(p, to_enu(p) + slow, round_covariances(len(p)), LOOSE)
        errors.append(yaw_of(found) - YAW)
        sigmas.append(np.sqrt(found.covariance[0, 0]))
    assert np.std(errors) < 2.0 * np.mean(sigmas)
    white = alignment(p, to_enu(p) + rng.normal(size=p.shape), round_covariances(len(p)), LOOSE)
    assert np.mean(sigmas) > 2.0 * np.sqrt(white.covariance[0, 0])


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_fixes_a_hundred_metres_off_do_not_count(share):
    rng = np.random.default_rng(4)
    p = antennas(200)
    f = to_enu(p) + 0.3 * rng.normal(size=p.shape)
    wrong = rng.permutation(len(p))[: int(share * len(p))]
    right = np.setdiff1d(np.arange(len(p)), wrong)
    clean = alignment(p[right], f[right], round_covariances(len(right)), 0.1)
    f[wrong] += 100 * rng.normal(size=(len(wrong), 3))
    found = alignment(p, f, round_covariances(len(p)), 0.1)
    assert not found.inlier[wrong].any()
    assert found.inlier.sum() == len(p) - len(wrong)
    np.testing.assert_allclose(found.T_enu_odom, clean.T_enu_odom, atol=1e-6)


def test_a_biased_stretch_of_fixes_does_not_count():
    p = antennas(300)
    f = to_enu(p)
    f[20:35] += [15.0, 10.0, 0.0]
    found = alignment(p, f, round_covariances(len(p)), 0.1)
    assert np.flatnonzero(~found.inlier).tolist() == list(range(20, 35))
    np.testing.assert_allclose(found.T_enu_odom, expected(), atol=1e-6)


def test_the_heading_becomes_known_as_the_way_grows():
    rng = np.random.default_rng(5)
    p = antennas(200)
    f = to_enu(p) + rng.normal(size=p.shape)
    known = [alignment(p[:k], f[:k], round_covariances(k), 0.1) is not None for k in range(len(p) + 1)]
    assert not any(known[:3])
    assert known[-1]
    first = known.index(True)
    sigma = 1.0 / np.sqrt(np.sum((p[:first, :2] - p[:first, :2].mean(0)) ** 2))
    assert sigma < 0.1


def test_one_place_has_no_heading():
    p = np.tile([3.0, 4.0, 5.0], (50, 1))
    assert alignment(p, to_enu(p), round_covariances(50), LOOSE) is None
    rng = np.random.default_rng(6)
    upwards = p + np.outer(np.arange(50), [0.0, 0.0, 1.0])
    assert alignment(upwards, to_enu(upwards) + rng.normal(size=p.shape), round_covariances(50), 0.1) is None
    assert alignment(p[:1], p[:1], round_covariances(1), LOOSE) is None
    assert alignment(p[:0], p[:0], round_covariances(0), LOOSE) is None


def test_fixes_without_agreement_have_no_heading():
    rng = np.random.default_rng(7)
    p = antennas(200)
    assert alignment(p, 1000 * rng.normal(size=p.shape), round_covariances(len(p)), 0.1) is None


def test_a_place_far_from_the_origin():
    """Kilometres from the frame's origin the covariances of yaw and place are nearly one."""
    p = antennas(100) + np.array([8e3, -9e3, 20.0])
    found = alignment(p, to_enu(p), round_covariances(len(p)), 0.1)
    np.testing.assert_allclose(found.T_enu_odom, expected(), atol=1e-5)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0
