"""GPS fixes from text tables."""

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.gps_text import read_gps_text


def test_local_fixes_with_and_without_sigmas(tmp_path):
    path = tmp_path / "gps.txt"
    path.write_text("1.5 1 2 3\n2.5 2 3 4\n")
    fixes = read_gps_text(path)
    assert fixes.stamp_ns.tolist() == [1_500_000_000, 2_500_000_000]
    np.testing.assert_allclose(fixes.position[1], [2, 3, 4])
    assert np.isnan(np.diagonal(fixes.covariance[0])).all()
    path.write_text("t,x,y,z,sx,sy,sz\n1.5,1,2,3,0.1,0.2,0.3\n")
    np.testing.assert_allclose(np.diagonal(read_gps_text(path).covariance[0]), [0.01, 0.04, 0.09])


def test_degrees_become_metres_from_the_first_fix(tmp_path):
    path = tmp_path / "gps.csv"
    path.write_text("t,latitude,longitude,altitude,sigma\n1,49.0,8.4,110,2\n2,49.001,8.4,110,2\n")
    fixes = read_gps_text(path)
    # a minute of latitude is a nautical mile
    assert fixes.position[1, 1] == pytest.approx(1852 * 60e-3, rel=2e-3)
    assert fixes.origin == (49.0, 8.4, 110.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "no fixes"),
        ("1 2 3\n", "3 columns"),
        ("1 2 3 4\n2 2 3\n", "line 2"),
        ("1 2 3 4\n1 2 3 4\n", "line 2"),
        ("1 2 3 4 0\n", "not positive"),
        ("t latitude longitude altitude\n1 4900 840 110\n", "latitude above 90"),
    ],
)
def test_a_wrong_table_is_named(tmp_path, text, expected):
    path = tmp_path / "gps.txt"
    path.write_text(text)
    with pytest.raises(LioJaxError, match=expected):
        read_gps_text(path)
