"""Keyframes are read as they were written; missing and damaged files are reported."""

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.run.keyframes import KeyframeWriter, read_keyframes

COUNT = 5


def poses(seed):
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    T[:, :3, 3] = np.random.default_rng(seed).normal(size=(COUNT, 3))
    return T


def cloud(number):
    return np.random.default_rng(number).normal(size=(10 + number, 3)).astype(np.float32)


def corners(number):
    return np.arange(10 + number) % 3 == 0


def write(folder, corner=True):
    writer = KeyframeWriter(folder)
    for number in range(COUNT):
        writer.append(cloud(number), corners(number) if corner else None)
    writer.finish(np.arange(COUNT) * 10**9, poses(1), poses(2))
    return writer


def test_names_and_numbers(tmp_path):
    write(tmp_path)
    names = sorted(entry.name for entry in (tmp_path / "keyframes").iterdir())
    assert names == [*(f"{number:06d}.npz" for number in range(COUNT)), "index.npz"]
    kept = read_keyframes(tmp_path)
    np.testing.assert_array_equal(kept.stamps_ns, np.arange(COUNT) * 10**9)
    np.testing.assert_array_equal(kept.T_odom_imu, poses(2))
    for number, (T_world_imu, points) in enumerate(kept.clouds()):
        np.testing.assert_array_equal(T_world_imu, poses(1)[number])
        np.testing.assert_array_equal(points, cloud(number))
        assert points.dtype == np.float32


def test_corners_and_surfaces_are_the_whole(tmp_path):
    write(tmp_path)
    kept = read_keyframes(tmp_path)
    for number in range(COUNT):
        np.testing.assert_array_equal(kept.points(number, "corner"), cloud(number)[corners(number)])
        np.testing.assert_array_equal(kept.points(number, "surface"), cloud(number)[~corners(number)])


def test_the_index_may_be_corrected(tmp_path):
    writer = write(tmp_path)
    writer.finish(np.arange(COUNT), poses(3), poses(2))
    np.testing.assert_array_equal(read_keyframes(tmp_path).T_world_imu, poses(3))


def test_a_pose_that_is_not_finite_has_no_place_in_a_map(tmp_path):
    writer = write(tmp_path)
    lost = poses(1)
    lost[2, 0, 3] = np.nan
    writer.finish(np.arange(COUNT), lost, poses(2))
    assert [len(points) for _, points in read_keyframes(tmp_path).clouds()] == [10, 11, 13, 14]


def test_an_index_of_another_length_is_refused(tmp_path):
    writer = write(tmp_path)
    with pytest.raises(ValueError, match="5 keyframes were written"):
        writer.finish(np.arange(COUNT - 1), poses(1)[1:], poses(2)[1:])


def remove(name):
    return lambda folder: (folder / name).unlink()


def replace(name, **arrays):
    return lambda folder: np.savez(folder / name, **arrays)


def cut(name):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:40])


DAMAGES = {
    "no index": (remove("index.npz"), r"index\.npz: missing, the run was ended"),
    "broken index": (cut("index.npz"), r"index\.npz: cannot be read"),
    "poor index": (replace("index.npz", stamps_ns=np.arange(5)), r"index\.npz: lacks T_world_imu, T_odom"),
    "short index": (
        replace("index.npz", stamps_ns=np.arange(4), T_world_imu=poses(1), T_odom_imu=poses(2)),
        r"index\.npz: its stamps and poses differ",
    ),
    "no cloud": (remove("000003.npz"), r"000003\.npz: missing"),
    "broken cloud": (cut("000003.npz"), r"000003\.npz: cannot be read"),
    "flat cloud": (replace("000003.npz", points=np.zeros(12)), r"000003\.npz: holds no points"),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damage_is_said_in_a_sentence_with_the_file(tmp_path, case):
    damage, sentence = DAMAGES[case]
    write(tmp_path)
    damage(tmp_path / "keyframes")
    with pytest.raises(LioJaxError, match=sentence) as raised:
        list(read_keyframes(tmp_path).clouds())
    assert str(raised.value).endswith("run again.")


def test_no_keyframes(tmp_path):
    with pytest.raises(LioJaxError, match=r"keyframes: no such folder; the run kept no keyframes\.$"):
        read_keyframes(tmp_path)


def test_parts_of_a_recipe_that_tells_none_apart(tmp_path):
    write(tmp_path, corner=False)
    with pytest.raises(LioJaxError, match=r"separated no corners; take the part 'whole'"):
        read_keyframes(tmp_path).points(0, "corner")


def test_marks_of_another_length(tmp_path):
    write(tmp_path)
    np.savez(tmp_path / "keyframes" / "000000.npz", points=cloud(0), corner=np.ones(3, bool))
    with pytest.raises(LioJaxError, match=r"10 points, but 3 marks of corners"):
        read_keyframes(tmp_path).points(0, "surface")
