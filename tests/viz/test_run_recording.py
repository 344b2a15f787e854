from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.viz.run_recording import _unobserved

TURN = Rotation.from_euler("z", 90, degrees=True)


def tracked(information, open_directions, index=1):
    wxyz_xyz = np.concatenate([TURN.as_quat(scalar_first=True), np.zeros(3)])
    registration = SimpleNamespace(
        T_world_lidar=SimpleNamespace(wxyz_xyz=wxyz_xyz),
        information=information,
        degenerate=np.arange(6) < open_directions,
    )
    return SimpleNamespace(index=index, output=SimpleNamespace(registration=registration))


def pose():
    matrix = np.eye(4)
    matrix[:3, :3] = TURN.as_matrix()
    return matrix


def test_the_open_direction_is_drawn_in_the_lidars_axes():
    # along the lidar's x nothing is known
    information = np.diag([1e6, 1e6, 1e6, 1e-3, 1e4, 1e4])
    (arrow,) = _unobserved(tracked(information, 1), pose())
    np.testing.assert_allclose(np.abs(arrow), [1.0, 0.0, 0.0], atol=1e-6)


def test_an_open_turn_is_drawn_as_its_axis():
    information = np.diag([1e6, 1e6, 1e-3, 1e4, 1e4, 1e4])
    (arrow,) = _unobserved(tracked(information, 1), pose())
    np.testing.assert_allclose(np.abs(arrow), [0.0, 0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize(
    "of", [tracked(np.full((6, 6), np.nan), 6), tracked(np.eye(6), 6, index=0), tracked(np.eye(6), 0)]
)
def test_nothing_is_drawn_without_data(of):
    assert _unobserved(of, pose()).shape == (0, 3)
