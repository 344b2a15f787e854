"""Clouds with numbers that no sensor gives: what remains is used, and a sentence names the rest."""

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.core.timestamps import FARTHEST_NS
from tests.data import bags
from tests.data.cloud_files import packed, pcd_bytes, ply_bytes
from tests.data.test_clouds import BARE, CLOUD, POINTS, SEEN, folder, npy_bytes, opened

NAMES = [f"{bags.START_NS + number * bags.PERIOD_NS}.pcd" for number in range(4)]


def with_field(name: str, values: np.ndarray) -> np.ndarray:
    """Return the cloud with one field as float32 numbers."""
    plain = packed(CLOUD)
    fields = [(one, np.dtype("<f4") if one == name else plain.dtype[one]) for one in plain.dtype.names or ()]
    changed = np.zeros(plain.shape, fields)
    for one, _ in fields:
        changed[one] = plain[one]
    changed[name] = values
    return changed


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -3e20])
def test_points_whose_ring_is_no_number_are_dropped(tmp_path, wrong):
    rings = SEEN.ring.astype(np.float32)
    rings[:7] = wrong
    scans = list(opened(folder(tmp_path, NAMES, pcd_bytes(with_field("ring", rings)))).scans())
    assert [(len(scan.points), scan.dropped) for scan in scans] == [(POINTS - 7, 7)] * 4
    np.testing.assert_array_equal(scans[0].ring, SEEN.ring[7:])


@pytest.mark.parametrize("wrong", [1e25, -3e38])
def test_a_scan_whose_times_are_impossible_has_no_points(tmp_path, wrong):
    path = folder(tmp_path, NAMES, pcd_bytes(with_field("time", SEEN.time)))
    (path / NAMES[2]).write_bytes(pcd_bytes(with_field("time", np.full(POINTS, wrong))))
    sequence = opened(path)
    scans = list(sequence.scans())
    assert [len(scan.points) for scan in scans] == [POINTS, POINTS, 0, POINTS]
    assert [scan.stamp_ns for scan in scans] == [int(name[:-4]) for name in NAMES]
    assert f"{POINTS} points with impossible times were dropped" in " ".join(sequence.warnings_so_far)


def with_times(times: np.ndarray) -> bytes:
    """Return the cloud as an .npy file whose times are float64 numbers."""
    plain = packed(CLOUD)
    kinds = [(one, np.dtype("<f8") if one == "time" else plain.dtype[one]) for one in plain.dtype.names or ()]
    changed = plain.astype(kinds)
    changed["time"] = times
    return npy_bytes(changed)


ARRAYS = [name.replace("pcd", "npy") for name in NAMES]


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("absolute", [True, False])
@pytest.mark.parametrize("wrong", [1e305, -1.7e308])
@pytest.mark.parametrize("which", [slice(3, 4), slice(None), slice(None, None, 2)])
@pytest.mark.parametrize("damaged", [range(1), range(2, 3), range(4)])
def test_times_near_the_limit_of_float64_overflow_nowhere(tmp_path, damaged, which, wrong, absolute, named):
    for number in range(4):
        times = SEEN.time.astype(np.float64) + absolute * (bags.START_NS * 1e-9 + 0.1 * number)
        if number in damaged:
            times[which] = wrong
        name = ARRAYS[number] if named else f"{number}.npy"
        folder(tmp_path, [name], with_times(times))
    sequence = opened(tmp_path)
    scans = list(sequence.scans())
    assert all(np.isfinite(scan.time).all() and abs(scan.stamp_ns) < FARTHEST_NS for scan in scans)
    if damaged != range(4):
        assert sum(len(scan.points) == POINTS for scan in scans) == 3
        assert "points with impossible times were dropped" in " ".join(sequence.warnings_so_far)


def test_times_that_hardly_differ_count_as_equal(tmp_path):
    times = np.where(np.arange(POINTS) % 2, 5e-324, -5e-324)
    sequence = opened(folder(tmp_path, ARRAYS, with_times(times)))
    assert any("holds a single value, reconstructed from azimuth" in note for note in sequence.info.notes)


@pytest.mark.parametrize("wrong", [-5e23, 5e23])
def test_one_impossible_time_in_the_first_scan_leaves_possible_stamps(tmp_path, wrong):
    """The spread of the first scans, by which times are recognised, is then impossible too."""
    path = folder(tmp_path, NAMES[:1], pcd_bytes(with_field("time", SEEN.time)))
    times = SEEN.time.copy()
    times[3] = wrong
    (path / NAMES[0]).write_bytes(pcd_bytes(with_field("time", times)))
    sequence = opened(path)
    (scan,) = sequence.scans()
    assert abs(scan.stamp_ns) < FARTHEST_NS
    assert np.isfinite(scan.time).all()
    assert "points with impossible times were dropped" in " ".join(sequence.warnings_so_far)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_number_of_points_beyond_the_file_is_a_truncation(tmp_path, form):
    content = ply_bytes(CLOUD, form)
    stated = b"9" * 25
    damaged = content.replace(b"vertex %d" % POINTS, b"vertex " + stated)
    path = folder(tmp_path, [name.replace("pcd", "ply") for name in NAMES], content)
    (path / NAMES[1].replace("pcd", "ply")).write_bytes(damaged)
    sequence = opened(path)
    assert [len(scan.points) for scan in sequence.scans()] == [POINTS] * 4
    assert f"of {stated.decode()} points" in sequence.warnings_so_far[0]


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        (".pcd", pcd_bytes(CLOUD)),
        (".ply", ply_bytes(CLOUD)),
        (".npy", npy_bytes(packed(CLOUD))),
        (".bin", BARE.tobytes()),
    ],
)
def test_a_folder_that_is_lost_ends_the_scans(tmp_path, suffix, content):
    path = folder(tmp_path / "walk", [name.replace(".pcd", suffix) for name in NAMES], content)
    sequence = opened(path)
    path.rename(tmp_path / "elsewhere")
    with pytest.raises(LioJaxError, match=r"walk: is gone while it was read \(No such file or directory\)"):
        list(sequence.scans())
