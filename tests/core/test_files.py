"""A file appears whole or not at all."""

import os
import resource
import zipfile
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.files import aside_of, atomic_path, folder_lock, parse_yaml, read_arrays, remove_leftovers


def test_file_appears_when_the_block_ends(tmp_path):
    target = tmp_path / "trajectory.tum"
    with atomic_path(target) as aside:
        aside.write_text("first")
        assert not target.exists()
        assert aside.parent == tmp_path
    assert target.read_text() == "first"
    assert os.listdir(tmp_path) == ["trajectory.tum"]


def test_temporary_keeps_the_suffix(tmp_path):
    with atomic_path(tmp_path / "states.npz") as aside:
        assert aside.suffix == ".npz"
        aside.touch()


def test_old_file_stays_until_the_new_one_is_whole(tmp_path):
    target = tmp_path / "metrics.json"
    target.write_text("old")
    with atomic_path(target) as aside:
        aside.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"


def write_half(target: Path, error: type[BaseException]) -> None:
    with atomic_path(target) as aside:
        aside.write_text("half")
        raise error


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_failure_leaves_no_file(tmp_path, error):
    with pytest.raises(error):
        write_half(tmp_path / "map.pcd", error)
    assert os.listdir(tmp_path) == []


def test_failure_leaves_the_old_file_as_it_was(tmp_path):
    target = tmp_path / "map.pcd"
    target.write_text("old")
    with pytest.raises(RuntimeError):
        write_half(target, RuntimeError)
    assert os.listdir(tmp_path) == ["map.pcd"]
    assert target.read_text() == "old"


def test_two_writers_of_one_file_do_not_share_a_temporary(tmp_path):
    target = tmp_path / "config.yaml"
    with atomic_path(target) as one, atomic_path(target) as two:
        assert one != two
        one.write_text("one")
        two.write_text("two")
    assert target.read_text() == "one"
    assert os.listdir(tmp_path) == ["config.yaml"]


@pytest.mark.parametrize("name", ["map.pcd", "drive", "a.b.bag", "odd [name] (1).txt"])
def test_leftovers_are_those_of_the_one_file(tmp_path, name):
    aside_of(tmp_path / name).write_text("half")
    (aside_of(tmp_path / name) / "scans").mkdir(parents=True)
    kept = {aside_of(tmp_path / f"other_{name}"), aside_of(tmp_path / f"{name}.zip"), tmp_path / name}
    for path in kept:
        path.touch()
    remove_leftovers(tmp_path / name)
    assert set(tmp_path.iterdir()) == kept


def test_a_link_among_the_leftovers_is_removed_and_not_followed(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "precious").touch()
    aside_of(tmp_path / "out").symlink_to(tmp_path / "data")
    remove_leftovers(tmp_path / "out")
    assert os.listdir(tmp_path) == ["data"]
    assert (tmp_path / "data" / "precious").exists()


def test_a_lock_is_held_once(tmp_path):
    with folder_lock(tmp_path) as first, folder_lock(tmp_path) as second:
        assert first
        assert not second
    with folder_lock(tmp_path) as again:
        assert again
    assert os.listdir(tmp_path) == []


def test_a_folder_whose_writer_lives_is_no_leftover(tmp_path):
    living, dead = aside_of(tmp_path / "drive"), aside_of(tmp_path / "drive")
    living.mkdir()
    dead.mkdir()
    with folder_lock(living):
        remove_leftovers(tmp_path / "drive")
    assert list(tmp_path.iterdir()) == [living]


def saved(path: Path) -> bytes:
    np.savez_compressed(path, points=np.arange(3000.0), note=np.array("a"))
    return path.read_bytes()


def test_arrays_come_back(tmp_path):
    saved(tmp_path / "a.npz")
    read = read_arrays(tmp_path / "a.npz")
    np.testing.assert_array_equal(read["points"], np.arange(3000.0))


@pytest.mark.parametrize("cut", [0, 1, 30, 200, 1000, -1])
def test_a_cut_file_of_arrays_is_damaged(tmp_path, cut):
    path = tmp_path / "a.npz"
    path.write_bytes(saved(path)[:cut])
    with pytest.raises(ValueError, match=r"."):
        read_arrays(path)


@pytest.mark.parametrize("seed", range(40))
def test_overwritten_bytes_are_a_damage_or_harmless(tmp_path, seed):
    path, rng = tmp_path / "a.npz", np.random.default_rng(seed)
    data = bytearray(saved(path))
    for at in rng.integers(0, len(data), 8):
        data[at] = rng.integers(256)
    path.write_bytes(data)
    with suppress(ValueError):
        read_arrays(path)


def test_one_array_is_no_archive(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    with pytest.raises(ValueError, match=r"no \.npz archive"):
        read_arrays(tmp_path / "a.npy")


def test_objects_are_not_unpickled(tmp_path):
    np.savez(tmp_path / "a.npz", evil=np.array([{}], object))
    with pytest.raises(ValueError, match="allow_pickle"):
        read_arrays(tmp_path / "a.npz")


def test_arrays_that_would_unpack_to_far_more_than_their_file_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, points=np.zeros(1 << 20))
    assert read_arrays(path)["points"].shape == (1 << 20,)
    monkeypatch.setattr("lio_jax.core.files._UNPACKED_BYTES", 1 << 20)
    with pytest.raises(ValueError, match="would unpack to 8388"):
        read_arrays(path)
    np.savez(path, points=np.zeros(1 << 20))
    assert read_arrays(path)["points"].shape == (1 << 20,)


@pytest.mark.parametrize("count", [1 << 36, 1 << 44, 1 << 60])
def test_an_array_of_declared_terabytes_is_refused(tmp_path, count):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive, archive.open("points.npy", "w") as member:
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f4", "fortran_order": False, "shape": (count,)}
        )
        member.write(bytes(1000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"."):
        read_arrays(tmp_path / "a.npz")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 18


def each_ten_times(first: str, entry: str) -> str:
    """Return a YAML text of eight values, each of which holds the one before it ten times."""
    names = "abcdefgh"
    lines = [f"a: &a {first}"]
    for before, name in pairwise(names):
        lines.append(f"{name}: &{name} {entry.format(', '.join([f'*{before}'] * 10))}")
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (each_ten_times("[x]", "[{}]"), "too many values"),
        (each_ten_times("{x: 1}", "{{<<: [{}]}}"), "too many values"),
        ("[" + "1," * 2000 + "1]", "too many values"),
        ("# " + "x" * 1_000_000, "longer than 1000000 characters"),
        ("a: &a [*a]", "within itself"),
        ("a: \0", "special characters are not allowed"),
        ("[" * 900, "too deeply"),
        ("a: 1" + ":1" * 100_000, "a number of 200001 characters"),
        ("a: 0x" + "1" * 100_000, "a number of 100002 characters"),
    ],
    ids=[
        "aliases",
        "merged aliases",
        "values",
        "characters",
        "itself",
        "letters",
        "depth",
        "sexagesimal",
        "digits",
    ],
)
def test_a_yaml_text_that_would_take_all_time_or_memory_is_refused(text, reason, monkeypatch):
    # a text with as many values as are allowed takes seconds
    monkeypatch.setattr("lio_jax.core.files._MOST_NODES", 1000)
    with pytest.raises(ValueError, match=reason):
        parse_yaml(text)


def test_yaml_with_aliases_and_merged_keys_is_read():
    assert parse_yaml("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: [*a, *a]") == {
        "a": {"x": 1, "y": 2},
        "b": {"x": 1, "y": 3},
        "c": [{"x": 1, "y": 2}] * 2,
    }
    assert parse_yaml("") is None
    assert parse_yaml("a: 1.5e3\nb: 12:30") == {"a": "1.5e3", "b": 750}


def test_yaml_tags_make_no_objects():
    with pytest.raises(ValueError, match="could not determine a constructor"):
        parse_yaml("!!python/object/apply:os.getcwd []")
