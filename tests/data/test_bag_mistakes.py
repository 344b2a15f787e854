"""A bag appears complete or not at all, and one sentence names the reason."""

import errno
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.bag_writer import write_bag
from lio_jax.data.config import DataConfig
from lio_jax.data.native_writer import write_native
from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.sequence import LidarScan
from tests.data.recorded import FORMATS, SCANS, Recorded, recorded_sequence, write
from tests.full_disk import full_disk_after


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return recorded_sequence()


@pytest.mark.parametrize("name", FORMATS)
def test_what_exists_is_kept_unless_asked_otherwise(tmp_path: Path, recorded: Recorded, name: str) -> None:
    shorter = replace(recorded, all_scans=recorded.all_scans[:1])
    write(tmp_path / name, recorded)
    with pytest.raises(UsageError, match="exists already"):
        write(tmp_path / name, shorter)
    assert RosbagSequence(tmp_path / name, DataConfig()).info.scan_count == SCANS
    write(tmp_path / name, shorter, overwrite=True)
    assert RosbagSequence(tmp_path / name, DataConfig()).info.scan_count == 1
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


def test_a_folder_that_is_no_bag_is_never_overwritten(tmp_path: Path, recorded: Recorded) -> None:
    for name, reason in (("b", "not a ROS 2 bag"), ("a.bag", "is a folder")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "draft.txt").write_text("years of work")
        with pytest.raises(UsageError, match=reason):
            write(tmp_path / name, recorded, overwrite=True)
        assert (tmp_path / name / "draft.txt").read_text() == "years of work"


@pytest.mark.parametrize(
    ("name", "bag_format", "wanted"),
    [
        ("x", "ros1", ".bag"),
        ("x.mcap", "ros1", ".bag"),
        ("x.bag", "ros2-mcap", ".mcap or a folder"),
        ("x.mcap", "ros2-sqlite3", ".db3 or a folder"),
        ("x#1", "ros2-sqlite3", "'#'"),
    ],
)
def test_a_name_that_does_not_fit_the_format(tmp_path, recorded, name, bag_format, wanted) -> None:
    with pytest.raises(UsageError, match=wanted):
        write_bag(tmp_path / name, recorded, bag_format=bag_format, layout="velodyne")
    assert list(tmp_path.iterdir()) == []


def test_unknown_layout_names_those_that_exist(tmp_path: Path, recorded: Recorded) -> None:
    with pytest.raises(UsageError, match="'hesai' is unknown; choose one of: velodyne, ouster, livox"):
        write(tmp_path / "a.bag", recorded, "hesai")


def test_no_scans(tmp_path: Path, recorded: Recorded) -> None:
    with pytest.raises(LioJaxError, match="no scans to write"):
        write(tmp_path / "a.bag", replace(recorded, all_scans=[]))
    assert list(tmp_path.iterdir()) == []


def test_gps_without_an_origin(tmp_path: Path, recorded: Recorded) -> None:
    assert recorded.gps_data is not None
    local = replace(recorded, gps_data=replace(recorded.gps_data, origin=(np.nan,) * 3))
    with pytest.raises(LioJaxError, match="no geodetic origin"):
        write(tmp_path / "a.bag", local)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("sensor fell off")])
@pytest.mark.parametrize("name", FORMATS)
def test_a_failure_leaves_nothing(tmp_path, recorded, name, error) -> None:
    def failing() -> Iterator[LidarScan]:
        yield from recorded.all_scans[:2]
        assert not (tmp_path / name).exists()
        raise error

    with pytest.raises(type(error)):
        write(tmp_path / name, recorded, scans=failing())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [6_000, 60_000])
@pytest.mark.parametrize("name", FORMATS)
def test_a_full_disk_is_reported_in_one_sentence_and_leaves_no_file(tmp_path, recorded, name, size) -> None:
    write(tmp_path / name, recorded, overwrite=True)
    before = sorted(path.name for path in tmp_path.rglob("*"))
    with full_disk_after(size), pytest.raises(LioJaxError) as caught:
        write(tmp_path / name, recorded, overwrite=True)
    assert str(caught.value).startswith(f"{tmp_path / name}: cannot be written (")
    assert "check its permissions and the free space" in str(caught.value)
    assert sorted(path.name for path in tmp_path.rglob("*")) == before
    assert RosbagSequence(tmp_path / name, DataConfig()).info.scan_count == SCANS


def test_a_full_disk_while_a_native_folder_is_written(tmp_path: Path, recorded: Recorded) -> None:
    with full_disk_after(10_000), pytest.raises(LioJaxError, match="native: cannot be written"):
        write_native(tmp_path / "native", recorded.scans())
    assert list(tmp_path.iterdir()) == []


def test_no_space_when_a_file_is_opened(tmp_path, recorded, monkeypatch) -> None:
    def full(self: Path, *_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device", str(self))

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(LioJaxError, match=r"a\.bag: cannot be written \(No space left on device\)"):
        write(tmp_path / "a.bag", recorded)
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_the_source_is_not_blamed_on_the_output(tmp_path: Path, recorded: Recorded) -> None:
    def failing() -> Iterator[LidarScan]:
        yield recorded.all_scans[0]
        raise FileNotFoundError(errno.ENOENT, "No such file", "/mnt/stick/000001.bin")

    with pytest.raises(FileNotFoundError, match="stick"):
        write(tmp_path / "a.bag", recorded, scans=failing())
    assert list(tmp_path.iterdir()) == []
