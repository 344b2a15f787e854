"""Pairs of times from a text file: the pairs that are read, and the messages on wrong lines."""

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.loops.proposals import keyframe_at, read_pairs
from tests.loops.places import keyframe, pose


def written(tmp_path, text):
    path = tmp_path / "pairs.txt"
    path.write_text(text)
    return path


def test_times_are_kept_to_the_nanosecond_and_sorted_by_the_later_one(tmp_path):
    text = "# seconds\n1700000000.123456789 1700000100.5\n\n1700000050.0, 1700000020.25  # commas\n"
    first, second = read_pairs(written(tmp_path, text))
    assert (first.line, first.earlier_ns, first.later_ns) == (4, 1700000020_250000000, 1700000050_000000000)
    assert (second.line, second.earlier_ns, second.later_ns) == (
        2,
        1700000000_123456789,
        1700000100_500000000,
    )
    assert first.T_earlier_later is None


def test_a_pose_belongs_to_the_first_time_whichever_is_earlier(tmp_path):
    quarter = "0 0 0.7071067811865476 0.7071067811865476"
    forward, backward = read_pairs(written(tmp_path, f"10 20 1 2 3 {quarter}\n30 15 1 2 3 {quarter}\n"))
    T = pose(1, 2, 3, np.pi / 2)
    np.testing.assert_allclose(forward.T_earlier_later, T, atol=1e-12)
    np.testing.assert_allclose(backward.T_earlier_later, np.linalg.inv(T), atol=1e-12)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1 2 3", "3 numbers"),
        ("1 two", "not all numbers"),
        ("1 nan", "not all finite"),
        ("5 5", "needs two"),
        ("1 2 0 0 0 0 0 0 0", "norm 0"),
        ("1 2 0 0 0 1 1 0 0", "norm 1.41"),
    ],
)
def test_a_wrong_line_is_named(tmp_path, line, says):
    with pytest.raises(LioJaxError, match=rf"pairs\.txt, line 2: .*{says}"):
        read_pairs(written(tmp_path, f"1 2\n{line}\n"))


def test_a_missing_file_is_a_wrong_request(tmp_path):
    with pytest.raises(UsageError, match=r"none\.txt"):
        read_pairs(tmp_path / "none.txt")


def test_a_file_that_is_not_text_is_an_error(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(LioJaxError, match="not a text file"):
        read_pairs(path)


@pytest.mark.parametrize(("seconds", "index"), [(4.0, None), (5.0, 0), (24.9, 1), (25.0, 2), (900.0, 2)])
def test_the_keyframe_at_a_time_is_the_last_up_to_it(seconds, index):
    keyframes = [keyframe(k, pose(), seconds=5.0 + 10 * k) for k in range(3)]
    assert keyframe_at(keyframes, round(seconds * 1e9)) == index
