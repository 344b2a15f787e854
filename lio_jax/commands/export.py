"""``lio-jax export``: write a recording in another format."""

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import Literal

from tqdm import tqdm

from lio_jax.commands.run import resolve_settings
from lio_jax.commands.runtime import say
from lio_jax.commands.sim import truth_beside
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.bag_writer import FORMAT_OF_ENDING, BagFormat, write_bag
from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.kitti_writer import write_kitti
from lio_jax.data.native_writer import write_native
from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.data.span import Span
from lio_jax.data.trajectory import write_tum
from lio_jax.data.whole_output import written_whole
from lio_jax.run.run import check_start

Target = Literal["bag", "kitti", "native"]


def export(
    data: Path,
    to: Target,
    out: Path,
    assignments: tuple[str, ...],
    layout: str,
    start: int,
    scans: int | None,
    overwrite: bool,
) -> None:
    """Write one recording in another format from the command line.

    Raises:
        UsageError: the path does not fit the format or is taken, or the recording ends before ``start``.
        LioJaxError: there is nothing to write, or the disk is full or cannot be written.
    """
    if start < 0 or (scans is not None and scans < 1):
        raise UsageError(f"--start must be 0 or more and --scans 1 or more, not {start} and {scans}.")
    config = resolve_settings("default", assignments).run.data
    bag_format = _bag_format(out, to)
    sequence: Sequence = open_sequence(data, config)
    check_start(sequence, start)
    for note in sequence.info.notes:
        say(f"note: {note}")
    sequence = Span(sequence, start, scans)
    streamed = _with_progress(sequence)
    first = next(streamed, None)
    if first is None:
        raise LioJaxError(f"{data}: no scan could be read. {' '.join(sequence.warnings_so_far)}".strip())
    count = _written(out, to, bag_format, sequence, chain([first], streamed), layout, config, overwrite)
    for warning in sequence.warnings_so_far:
        say(f"warning: {warning}")
    for note in _left_out(out, to, sequence):
        say(f"note: {note}")
    print(f"recording  {out}  ({bag_format if to == 'bag' else to})\nscans      {count}")
    if hint := _reading_hint(to, first):
        print(f"run it     lio-jax run {out} {hint} --out DIR")


def _bag_format(out: Path, to: Target) -> BagFormat:
    if to == "bag" and out.suffix not in FORMAT_OF_ENDING:
        raise UsageError(f"{out}: a bag's name ends in {', '.join(FORMAT_OF_ENDING)}; choose one of them.")
    if to != "bag" and out.suffix in FORMAT_OF_ENDING:
        raise UsageError(f"{out}: --to {to} writes a folder; leave out the ending {out.suffix}.")
    return FORMAT_OF_ENDING.get(out.suffix, "ros1")


def _written(
    out: Path,
    to: Target,
    bag_format: BagFormat,
    sequence: Sequence,
    scans: Iterator[LidarScan],
    layout: str,
    config: DataConfig,
    overwrite: bool,
) -> int:
    info = sequence.info
    if to == "bag":
        return _write_bag(out, bag_format, sequence, scans, layout, overwrite)
    if to == "kitti":
        correction = config.vertical_correction_deg
        return write_kitti(
            out, sequence, vertical_correction_deg=correction, scans=scans, overwrite=overwrite
        )
    return write_native(
        out,
        scans,
        name=info.name,
        sensor=info.sensor,
        T_imu_lidar=info.T_imu_lidar,
        imu=sequence.imu(),
        gps=sequence.gps(),
        truth=sequence.truth(),
        overwrite=overwrite,
    )


def _write_bag(
    out: Path,
    bag_format: BagFormat,
    sequence: Sequence,
    scans: Iterator[LidarScan],
    layout: str,
    overwrite: bool,
) -> int:
    """Write the bag and its truth files, all of them or nothing."""
    truth = sequence.truth()
    with ExitStack() as stack:
        if truth is not None:
            poses, _ = truth_beside(out)
            write_tum(stack.enter_context(written_whole(poses, overwrite)), truth)
        return write_bag(
            out, sequence, bag_format=bag_format, layout=layout, scans=scans, overwrite=overwrite
        )


def _left_out(out: Path, to: Target, sequence: Sequence) -> list[str]:
    """Return sentences on the data that the recording holds and the format cannot hold."""
    if to != "kitti":
        return []
    has = {"inertial samples": sequence.imu(), "GPS fixes": sequence.gps()}
    there = [name for name, data in has.items() if data is not None]
    notes = [f"a KITTI odometry sequence holds no {' and no '.join(there)}; left out."] if there else []
    if sequence.truth() is not None and not (out / "poses.txt").exists():
        notes.append("the truth does not cover the scans; no poses.txt was written.")
    return notes


def _reading_hint(to: Target, first: LidarScan) -> str:
    """Return the setting without which the times of the points would be misunderstood."""
    compensated = first.duration == 0
    if to == "kitti" and not compensated:
        return "--set config.data.compensated=no"
    if to == "bag" and compensated:
        return "--set config.data.compensated=yes"
    return ""


def _with_progress(sequence: Sequence) -> Iterator[LidarScan]:
    with tqdm(total=sequence.info.scan_count, unit="scan", disable=None, leave=False) as bar:
        for scan in sequence.scans():
            yield scan
            bar.update()
