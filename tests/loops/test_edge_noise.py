"""How sure the edges of the back end are."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from lio_jax.core.geometry import carried
from lio_jax.core.types import CONVERGED
from lio_jax.loops.edge_noise import fix_covariance, stated_growth
from lio_jax.run.keyframes import KeyframePicker
from lio_jax.settings.settings import Settings


def step(rng):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    return T


def random_covariance(rng, scale):
    root = scale * rng.normal(size=(6, 9))
    return root @ root.T


def test_the_growth_is_the_noise_of_independent_increments_and_adds_up_along_a_chain():
    rng = np.random.default_rng(0)
    first = covariance = random_covariance(rng, 0.1)
    T_first_now, total = np.eye(4), np.zeros((6, 6))
    for _ in range(5):
        noise, T = random_covariance(rng, 0.01), step(rng)
        after = carried(covariance, np.linalg.inv(T)) + noise
        growth = stated_growth(covariance, after, np.linalg.inv(T))
        np.testing.assert_allclose(growth, noise, atol=1e-12)
        total = carried(total, np.linalg.inv(T)) + growth
        covariance, T_first_now = after, T_first_now @ T
    np.testing.assert_allclose(total, covariance - carried(first, np.linalg.inv(T_first_now)), atol=1e-10)


def test_directions_in_which_a_match_lowers_the_covariance_do_not_grow():
    before, after = np.diag([1.0, 1, 1, 4, 4, 4]), np.diag([1.0, 1, 1, 9, 1, 4])
    np.testing.assert_allclose(stated_growth(before, after, np.eye(4)), np.diag([0, 0, 0, 5.0, 0, 0]))


def test_a_fix_has_at_least_the_least_variance_and_the_height_that_is_used():
    stated = np.array([[0.04, 0.01, 0.1], [0.01, 3.0, 0.2], [0.1, 0.2, 9.0]])
    raised = [[1.0, 0.01, 0.1], [0.01, 3.0, 0.2], [0.1, 0.2, 9.0]]
    np.testing.assert_allclose(fix_covariance(stated, True, 1.0, 0.01), raised)
    level = [[0.04, 0.01, 0.0], [0.01, 3.0, 0.0], [0.0, 0.0, 0.05]]
    np.testing.assert_allclose(fix_covariance(stated[None], False, 0.02, 0.05, jnp)[0], level)


def result(number, covariance, failure="", degenerate=False, lost=False):
    """Return what the picker reads of a scan, two metres further along x."""
    T = np.eye(4)
    T[0, 3] = 2.0 * number
    whole = None if covariance is None else np.pad(covariance, (0, 18))
    registration = SimpleNamespace(status=CONVERGED, degenerate=np.array([degenerate] + [False] * 5))
    output = SimpleNamespace(
        lost=lost,
        covariance=whole,
        registration=registration,
        restarted=None,
        points=np.zeros((1, 3), np.float32),
        points_mask=np.ones(1, bool),
        origin=T[:3, 3],
    )
    return SimpleNamespace(stamp_ns=number, T_world_imu=T, outage=None, failure=failure, output=output)


def picked(*results):
    pick = KeyframePicker(Settings())
    return [np.sqrt(np.diag(pick(one).covariance)) for one in results]


SURE = np.diag([1e-8] * 3 + [1e-6] * 3)
OPEN = SURE + np.diag([0, 0, 0, 1.0, 0, 0])


def test_where_a_direction_is_open_this_direction_alone_is_loose():
    _, sigma = picked(result(0, SURE), result(1, OPEN, "the scene leaves 1 of 6 open", degenerate=True))
    backend = Settings().values["backend"]
    assert np.isclose(sigma[3], backend["odometry_scale"], rtol=0.01)
    np.testing.assert_allclose(sigma[:3], backend["odometry_rotation_sigma"], rtol=0.2)
    np.testing.assert_allclose(sigma[4:], backend["odometry_translation_sigma"], rtol=0.2)


def test_after_another_failure_or_without_a_covariance_all_directions_have_one_sigma():
    loose = [0.1] * 3 + [1.0] * 3
    np.testing.assert_allclose(picked(result(0, SURE), result(1, OPEN, "lost", lost=True))[1], loose)
    np.testing.assert_allclose(picked(result(0, None), result(1, None, "open", degenerate=True))[1], loose)
    backend = Settings().values["backend"]
    usual = np.repeat([backend["odometry_rotation_sigma"], backend["odometry_translation_sigma"]], 3)
    np.testing.assert_allclose(picked(result(0, None), result(1, None))[1], usual)
