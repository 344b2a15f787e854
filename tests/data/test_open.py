from dataclasses import fields
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data import detect, native, open_sequence, write_native
from lio_jax.data.config import DataConfig
from lio_jax.data.sequence import Reader
from tests.data import bags
from tests.data.captures import box, received, write_pcap
from tests.data.cloud_files import write_pcd_folder
from tests.data.ouster_captures import frames, write_capture
from tests.data.test_kitti import write_sequence
from tests.data.test_kitti_raw import write_drive
from tests.data.test_native import scans
from tests.run.small_drive import bag_messages, moving
from tests.shared_data import SHARED_DATA, needs_shared


@needs_shared
@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("kitti_odometry/sequences/04", "kitti_odometry"),
        ("kitti_raw/2011_09_26/2011_09_26_drive_0060_sync", "kitti_raw"),
        ("ouster/os1_128_3scans.bag", "rosbag"),
    ],
)
def test_real_recordings_find_their_reader(path: str, kind: str) -> None:
    sequence = open_sequence(SHARED_DATA / path)
    assert sequence.info.format == kind
    scan = next(sequence.scans())
    assert len(scan.points) == len(scan.time) == len(scan.ring) == len(scan.intensity) > 50_000
    assert scan.points.flags.c_contiguous
    assert np.isfinite(scan.points).all()


class Spied(DataConfig):
    """A config that knows which of its fields were read."""

    read: ClassVar[set[str]] = set()

    def __getattribute__(self, name: str) -> object:
        Spied.read.add(name)
        return super().__getattribute__(name)


def _own(kind: str, folder: Path) -> Path:
    if kind == "native":
        write_native(folder / "s", scans(2))
        return folder / "s"
    if kind == "kitti_raw":
        return write_drive(folder)
    if kind == "kitti_odometry":
        return write_sequence(folder)
    if kind == "clouds":
        return write_pcd_folder(folder / "s", scans(2))
    if kind == "velodyne_pcap":
        pytest.importorskip("velodyne_decoder", reason="velodyne-decoder is not installed: lio-jax[pcap]")
        return write_pcap(folder / "a.pcap", received(box(turns=1.0)))
    if kind == "ouster_pcap":
        pytest.importorskip(
            "ouster.sdk", reason="ouster-sdk is not installed: pip install --no-deps ouster-sdk"
        )
        return write_capture(folder / "a.pcap", *frames(1))
    return bags.write_bag(folder / "a.bag", bag_messages(moving()[:2], ros2=False))


@pytest.mark.parametrize("compensated", ["auto", "no"])
@pytest.mark.parametrize("reader", detect.READERS, ids=lambda reader: reader.name)
def test_readers_read_the_fields_that_they_name(tmp_path: Path, reader: Reader, compensated: str) -> None:
    Spied.read.clear()
    sequence = open_sequence(_own(reader.name, tmp_path), Spied(compensated=compensated))
    assert sequence.info.format == reader.name
    list(sequence.scans())
    sequence.imu()
    sequence.gps()
    names = {field.name for field in fields(DataConfig)}
    assert reader.reads <= names
    assert Spied.read & names <= reader.reads


def test_fields_without_effect_are_named() -> None:
    config = DataConfig(vertical_correction_deg=0.0, beams=16, prefetch=9)
    assert detect.without_effect("kitti_odometry", config) == ["beams"]
    assert detect.without_effect("native", config) == ["vertical_correction_deg", "beams"]
    assert detect.without_effect("rosbag", config) == ["vertical_correction_deg"]
    assert detect.without_effect("velodyne_pcap", config) == ["vertical_correction_deg", "beams"]
    assert detect.without_effect("memory", config) == []


def test_a_native_folder_finds_its_reader(tmp_path: Path) -> None:
    write_native(tmp_path / "s", scans(1))
    assert open_sequence(str(tmp_path / "s")).info.format == "native"


def _renamed(path: Path, config: DataConfig) -> native.NativeSequence:
    (path / "other.yaml").rename(path / "meta.yaml")
    return native.NativeSequence(path, config)


def test_a_new_reader_is_one_entry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = tmp_path / "all" / "recording"
    write_native(recording, scans(1))
    (recording / "meta.yaml").rename(recording / "other.yaml")
    reader = Reader(
        "other",
        "another folder (other.yaml)",
        lambda p: (p / "other.yaml").is_file(),
        _renamed,
        reads=frozenset({"compensated"}),
    )
    with pytest.raises(LioJaxError, match="the layout is not known"):
        open_sequence(recording)
    monkeypatch.setattr(detect, "READERS", (*detect.READERS, reader))
    assert len(list(open_sequence(recording).scans())) == 1
    (recording / "meta.yaml").rename(recording / "other.yaml")
    with pytest.raises(LioJaxError, match="one of those inside it: recording"):
        open_sequence(recording.parent)
    with pytest.raises(LioJaxError, match="is a part of a recording"):
        open_sequence(recording / "scans")
    (tmp_path / "empty").mkdir()
    with pytest.raises(LioJaxError, match=r"the folder is empty; give .*another folder \(other\.yaml\)"):
        open_sequence(tmp_path / "empty")


def test_nothing_there_is_an_error() -> None:
    with pytest.raises(LioJaxError, match="no such file or folder"):
        open_sequence("does/not/exist")


def test_an_empty_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LioJaxError, match="the folder is empty"):
        open_sequence(tmp_path)


def test_an_unknown_file_is_an_error_that_says_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "notes.pdf").write_text("hello")
    with pytest.raises(LioJaxError, match=r"notes\.pdf: not a recording.*velodyne/\*\.bin.*\.mcap"):
        open_sequence(tmp_path / "notes.pdf")


def test_an_unknown_folder_is_an_error_that_says_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(LioJaxError, match=r"layout is not known; looked for.*metadata\.yaml"):
        open_sequence(tmp_path)


def test_a_root_folder_names_the_sequences_inside(tmp_path: Path) -> None:
    for name in ("00", "07"):
        (tmp_path / "dataset" / "sequences" / name / "velodyne").mkdir(parents=True)
    (tmp_path / "dataset" / "poses").mkdir()
    with pytest.raises(LioJaxError, match="give one of those inside it: sequences/00, sequences/07"):
        open_sequence(tmp_path / "dataset")


def test_a_date_folder_names_the_drives_inside(tmp_path: Path) -> None:
    (tmp_path / "2011_09_26_drive_0001_sync" / "velodyne_points").mkdir(parents=True)
    (tmp_path / "calib_imu_to_velo.txt").write_text("")
    with pytest.raises(LioJaxError, match="inside it: 2011_09_26_drive_0001_sync"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("part", ["velodyne", "velodyne/000000.bin"])
def test_a_part_of_a_recording_names_the_whole(tmp_path: Path, part: str) -> None:
    (tmp_path / "04" / "velodyne").mkdir(parents=True)
    (tmp_path / "04" / "velodyne" / "000000.bin").write_bytes(b"0" * 16)
    with pytest.raises(LioJaxError, match=r"part of a recording; give the recording's folder, .*04\.$"):
        open_sequence(tmp_path / "04" / part)
