"""Compressed data that would fill the memory or the disk end in a sentence: kilobytes can be gigabytes."""

import bz2
import resource
import struct
from pathlib import Path

import lz4.frame
import pytest
from rosbags.rosbag2.storage_mcap import zstd

from lio_jax.core.errors import LioJaxError
from lio_jax.data import decompression
from lio_jax.data.decompression import limited
from lio_jax.data.rosbag import RosbagSequence
from tests.data import bags
from tests.data.bag_recordings import AUTO, FORMATS, SEEN, cloud_messages, storage_file

SMALL = 20_000
"""Limit of the tests, bytes; a cloud of theirs takes 31,680."""
CODECS = {
    "bz2": (bz2.compress, bz2.BZ2Decompressor),
    "lz4": (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
    "zstd": (zstd.compress, zstd.ZstdDecompressor),
}


@pytest.fixture
def small_limit(monkeypatch):
    monkeypatch.setattr(decompression, "MOST_BYTES", SMALL)


def written(path: Path, compressed: bool = True) -> Path:
    clouds = [bags.fill(bags.VELODYNE, SEEN, SEEN.time) for _ in range(3)]
    return bags.write_bag(path, cloud_messages(path, clouds), compressed=compressed)


@pytest.mark.parametrize("codec", CODECS)
def test_data_within_the_limit_are_whole(codec, small_limit):
    compress, make = CODECS[codec]
    assert limited(make, compress(bytes(SMALL))) == bytes(SMALL)
    # several frames, one after the other, as their own functions read them
    two = compress(b"a") + compress(b"b")
    assert limited(make, two) == b"ab"
    assert limited(make, compress(b"a") + b"after the end") == b"a"


@pytest.mark.parametrize("codec", CODECS)
def test_data_beyond_the_limit_are_refused(codec, small_limit):
    compress, make = CODECS[codec]
    for bomb in (
        compress(bytes(SMALL + 1)),
        compress(bytes(SMALL)) + compress(b"a"),
        compress(bytes(1 << 24)),
    ):
        with pytest.raises(ValueError, match="more than 20000 bytes"):
            limited(make, bomb)
    with pytest.raises(EOFError, match="cut off"):
        limited(make, compress(bytes(SMALL))[:-1])


@pytest.mark.parametrize("name", FORMATS)
def test_a_chunk_or_message_beyond_the_limit_is_damage(tmp_path, name, small_limit):
    path = written(tmp_path / name)
    with pytest.raises(LioJaxError, match="more than 20000 bytes") as caught:
        RosbagSequence(path, AUTO)
    assert str(caught.value).startswith(str(path))


def compressed_file(folder: Path, more: bytes = b"") -> Path:
    """Return a bag whose whole file is compressed, followed by further bytes within it."""
    path = written(folder / "a.db3", compressed=False)
    storage = storage_file(path)
    packed = path / f"{storage.name}.zstd"
    packed.write_bytes(zstd.compress(storage.read_bytes() + more))
    metadata = (path / "metadata.yaml").read_text()
    metadata = metadata.replace("compression_format: ''", "compression_format: zstd")
    metadata = metadata.replace("compression_mode: ''", "compression_mode: FILE")
    (path / "metadata.yaml").write_text(metadata.replace(storage.name, packed.name))
    storage.unlink()
    return path


def test_a_compressed_file_is_read(tmp_path):
    assert len(list(RosbagSequence(compressed_file(tmp_path), AUTO).scans())) == 3


def test_a_compressed_file_beyond_the_limit_leaves_nothing_on_the_disk(tmp_path, small_limit, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    path = compressed_file(tmp_path, bytes(1 << 26))
    with pytest.raises(LioJaxError, match="far more than a recording") as caught:
        RosbagSequence(path, AUTO)
    assert str(caught.value).startswith(str(path))
    assert list((tmp_path / "temporary").iterdir()) == []


def test_a_chunk_of_declared_exabytes_takes_no_memory(tmp_path):
    path = storage_file(written(tmp_path / "a.mcap"))
    data = path.read_bytes()
    # the index of chunks ends with the compression and both sizes
    at = data.rindex(b"zstd") + 4
    path.write_bytes(data[:at] + struct.pack("<QQ", 1 << 60, 1 << 60) + data[at + 16 :])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LioJaxError, match=r"a\.mcap|/a: "):
        RosbagSequence(path, AUTO)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 18


def test_names_in_a_bag_are_no_paths_to_write_to(tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    path = compressed_file(tmp_path)
    metadata = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(metadata.replace("a.db3.zstd", "../../a.db3.zstd"))
    before = sorted(tmp_path.rglob("*"))
    assert "../../" in (path / "metadata.yaml").read_text()
    assert len(list(RosbagSequence(path, AUTO).scans())) == 3
    assert sorted(tmp_path.rglob("*")) == before
