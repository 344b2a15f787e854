"""LAS files: every layout of points that laspy writes, and damaged headers, against the sweep written."""

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data import open_sequence
from tests.data.bags import PERIOD_NS, START_NS
from tests.data.test_clouds import POINTS, SEEN, folder, opened

laspy = pytest.importorskip("laspy", reason="laspy is not installed; it comes with lio-jax[las]")

RING = ("ring", "u2", SEEN.ring)
TIME = ("time", "f4", SEEN.time)
NAMES = [f"{START_NS + number * PERIOD_NS}.las" for number in range(3)]
VERSION, OFFSET, VLRS, FORMAT, RECORD, COUNT, COUNT_14 = 25, 96, 100, 104, 105, 107, 247
"""Places of numbers in the header, bytes (LAS 1.4, table 3)."""


def las_bytes(
    *extra: tuple[str, str, Any],
    version: str = "1.2",
    layout: int = 0,
    gps_time: Any = None,
    offset: float = 0.0,
    **scaling: Any,
) -> bytes:
    """Return the sweep as a LAS file in mm, with extra dimensions (name, type, values)."""
    header = laspy.LasHeader(version=version, point_format=layout)
    header.scales, header.offsets = np.full(3, 1e-3), np.full(3, offset)
    for name, kind, _ in extra:
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=kind, **scaling))
    las = laspy.LasData(header)
    las.x, las.y, las.z = SEEN.points.T.astype(np.float64)
    las.intensity = SEEN.intensity.astype(np.uint16)
    if gps_time is not None:
        las.gps_time = gps_time
    for name, _, values in extra:
        las[name] = values
    file = BytesIO()
    las.write(file)
    return file.getvalue()


def changed(content: bytes, place: int, form: str, value: float) -> bytes:
    """Return the file with one number of its header replaced."""
    data = bytearray(content)
    struct.pack_into("<" + form, data, place, value)
    return bytes(data)


SWEEP = las_bytes(RING, TIME)


@pytest.mark.parametrize(
    ("version", "layout"), [("1.2", 0), ("1.2", 1), ("1.2", 3), ("1.3", 4), ("1.4", 6), ("1.4", 7)]
)
@pytest.mark.parametrize("offset", [0.0, -1234.5])
def test_every_layout_gives_back_what_was_seen(
    tmp_path: Path, version: str, layout: int, offset: float
) -> None:
    content = las_bytes(RING, TIME, version=version, layout=layout, offset=offset)
    sequence = open_sequence(folder(tmp_path, NAMES, content))
    scans = list(sequence.scans())
    assert [scan.stamp_ns for scan in scans] == [START_NS + number * PERIOD_NS for number in range(3)]
    assert "per-point time: field 'time', float32 s relative, 0.0989 s a scan, " in sequence.info.notes[1]
    # metres, although the file counts in millimetres
    assert not any("in mm" in note for note in sequence.info.notes)
    for scan in scans:
        np.testing.assert_allclose(scan.points, SEEN.points, atol=5.1e-4)
        np.testing.assert_array_equal(scan.ring, SEEN.ring)
        np.testing.assert_array_equal(scan.intensity, SEEN.intensity.astype(np.uint16))
        np.testing.assert_allclose(scan.time, SEEN.time, atol=1e-8)
    assert sequence.warnings_so_far == ()


@pytest.mark.parametrize(("version", "layout"), [("1.2", 1), ("1.2", 3), ("1.4", 6)])
def test_gps_time_places_the_points_of_counted_scans(tmp_path: Path, version: str, layout: int) -> None:
    start = 300_123.5
    for number in range(3):
        times = start + 0.1 * number + SEEN.time.astype(np.float64)
        content = las_bytes(RING, version=version, layout=layout, gps_time=times)
        folder(tmp_path, [f"{number}.las"], content)
    sequence = opened(tmp_path)
    assert any("field 'gps_time', float64 s absolute" in note for note in sequence.info.notes)
    scans = list(sequence.scans())
    expected = [(start + 0.1 * number) * 1e9 for number in range(3)]
    np.testing.assert_allclose(np.subtract([scan.stamp_ns for scan in scans], expected), 0, atol=100)
    np.testing.assert_allclose(scans[2].time, SEEN.time, atol=1e-7)


@pytest.mark.parametrize(
    ("layout", "missing"), [(0, "not recorded"), (1, "field 'gps_time' holds a single value")]
)
def test_points_without_times_and_rings_get_both(tmp_path: Path, layout: int, missing: str) -> None:
    sequence = opened(folder(tmp_path, NAMES, las_bytes(layout=layout)))
    said = " ".join(sequence.info.notes)
    assert f"per-point time: {missing}, reconstructed from azimuth" in said
    assert "ring: not recorded, reconstructed from elevation as of 16 beams" in said
    np.testing.assert_array_equal(next(sequence.scans()).ring, SEEN.ring)


def test_an_extra_dimension_is_taken_before_gps_time(tmp_path: Path) -> None:
    content = las_bytes(TIME, layout=1, gps_time=np.arange(POINTS) * 1.0)
    sequence = opened(folder(tmp_path, NAMES, content))
    np.testing.assert_allclose(next(sequence.scans()).time, SEEN.time, atol=1e-8)
    sequence = opened(tmp_path, time_field="gps_time")
    assert any("field 'gps_time'" in note for note in sequence.info.notes)


def test_scaled_extra_dimensions_are_scaled(tmp_path: Path) -> None:
    content = las_bytes(("t", "i4", SEEN.time), scales=np.array([1e-6]), offsets=np.array([0.01]))
    scan = next(opened(folder(tmp_path, NAMES, content)).scans())
    np.testing.assert_allclose(scan.time, SEEN.time, atol=1e-6)


def test_extra_dimensions_of_several_numbers_are_left_out(tmp_path: Path) -> None:
    content = las_bytes(("time", "3f4", np.ones((POINTS, 3))), RING)
    sequence = opened(folder(tmp_path, NAMES, content))
    assert any("per-point time: not recorded" in note for note in sequence.info.notes)
    np.testing.assert_array_equal(next(sequence.scans()).ring, SEEN.ring)


def _without_points() -> bytes:
    file = BytesIO()
    laspy.LasData(laspy.LasHeader(version="1.2", point_format=1)).write(file)
    return file.getvalue()


RECORD_BYTES = 20 + 2 + 4
DAMAGES: dict[str, tuple[bytes, int, str]] = {
    "no point": (_without_points(), 0, "holds no points"),
    "cut within a point": (SWEEP[: -5 * RECORD_BYTES - 3], POINTS - 6, f"({POINTS - 6} of {POINTS} points)"),
    "cut behind the header": (SWEEP[: -POINTS * RECORD_BYTES], 0, f"truncated (0 of {POINTS} points)"),
    "number of points": (changed(SWEEP, COUNT, "I", 2**32 - 1), POINTS, f"({POINTS} of {2**32 - 1} points)"),
    "number of points, 1.4": (
        changed(las_bytes(RING, TIME, version="1.4", layout=6), COUNT_14, "Q", 2**64 - 1),
        POINTS,
        f"({POINTS} of {2**64 - 1} points)",
    ),
    "infinite scale": (changed(SWEEP, 131, "d", np.inf), 0, "holds no points"),
    "huge scale": (changed(SWEEP, 131, "d", 1e308), 0, "holds no points"),
}
"""A damaged file, the number of its points that are used, and what is said of it."""


@pytest.mark.parametrize("damage", DAMAGES)
def test_whole_points_of_a_damaged_file_are_used(tmp_path: Path, damage: str) -> None:
    content, left, said = DAMAGES[damage]
    path = folder(tmp_path, NAMES, SWEEP)
    (path / NAMES[1]).write_bytes(content)
    sequence = opened(path)
    assert [len(scan.points) for scan in sequence.scans()] == [POINTS, left, POINTS]
    assert said in " ".join(sequence.warnings_so_far)


BROKEN: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "it does not begin with the header of a LAS file"),
    "another format": (b"<html>404 not found</html>" * 9, "it does not begin with the header of a LAS file"),
    "cut within the header": (SWEEP[:150], "its points would begin at byte"),
    "offset of the points": (changed(SWEEP, OFFSET, "I", 2**32 - 1), f"begin at byte {2**32 - 1}"),
    "number of records": (changed(SWEEP, VLRS, "I", 2**32 - 1), f"no room for {2**32 - 1} variable length"),
    "format of points": (changed(SWEEP, FORMAT, "B", 37), "37"),
    "size of a point": (changed(SWEEP, RECORD, "H", 0), "Incoherent point size"),
    "compressed": (changed(SWEEP, FORMAT, "B", 128), "are compressed (LAZ): decompress them to .las"),
}
"""A file of which nothing can be read, and what is said of it."""


@pytest.mark.parametrize("damage", BROKEN)
def test_a_file_that_cannot_be_read_is_skipped(tmp_path: Path, damage: str) -> None:
    content, said = BROKEN[damage]
    path = folder(tmp_path, NAMES, SWEEP)
    (path / NAMES[1]).write_bytes(content)
    sequence = opened(path)
    assert len(list(sequence.scans())) == 2
    warning = " ".join(sequence.warnings_so_far)
    assert warning.startswith(f"{path / NAMES[1]}: ")
    assert said in warning
    assert "the scan was skipped" in warning


def test_compressed_files_are_refused(tmp_path: Path) -> None:
    path = folder(tmp_path / "laz", [name.replace("las", "laz") for name in NAMES], SWEEP)
    refusal = r"laz: holds compressed clouds \(\.laz\), which are not read; decompress them to \.las "
    with pytest.raises(LioJaxError, match=refusal):
        open_sequence(path)
    assert len(list(opened(folder(path, NAMES, SWEEP)).scans())) == 3
    # a record of the compressor, under a format that does not say so
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.vlrs.append(laspy.VLR("laszip encoded", 22204, record_data=bytes(46)))
    file = BytesIO()
    laspy.LasData(header).write(file)
    with pytest.raises(LioJaxError, match=r"no cloud can be read; .*decompress them to \.las"):
        opened(folder(tmp_path / "las", NAMES, file.getvalue()))
