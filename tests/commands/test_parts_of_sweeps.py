"""A bag whose messages hold fifths of a turn goes through the commands as that of whole sweeps does."""

import json
from pathlib import Path

import numpy as np
import pytest

from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.span import Span
from lio_jax.data.trajectory import write_tum
from tests.commands.conftest import PLAIN, Cli
from tests.data import bags
from tests.run.small_drive import COUNT, PERIOD_NS, extrinsics, moving, truth

FIFTH_NS = PERIOD_NS // 5


def _messages(parts: int, lost: tuple[int, ...] = ()) -> list[bags.Message]:
    """Return the drive in the layout of ouster_ros, each sweep in so many messages."""
    length, messages = PERIOD_NS // parts, []
    for scan in moving():
        since = np.round(scan.time.astype(np.float64) * 1e9).astype(np.int64)
        # in the order of firing, as packets come
        order = np.argsort(since, kind="stable")
        for part in range(parts):
            kept = order[since[order] // length == part]
            seen = bags.Sweep(scan.points[kept], scan.time[kept], scan.ring[kept], scan.intensity[kept])
            stamp = scan.stamp_ns + part * length
            cloud = bags.cloud_message(stamp, bags.fill(bags.OUSTER, seen, since[kept] - part * length))
            messages.append(("/points", stamp + length + 3_000_000, cloud))
    return [message for number, message in enumerate(messages) if number not in lost]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write_bag(tmp_path_factory.mktemp("whole") / "drive.mcap", _messages(1))


@pytest.fixture(scope="module")
def in_parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write_bag(tmp_path_factory.mktemp("parts") / "drive.mcap", _messages(5))


def test_the_run_is_that_of_whole_sweeps(cli: Cli, tmp_path: Path, whole: Path, in_parts: Path) -> None:
    out = {}
    for name, bag in (("whole", whole), ("parts", in_parts)):
        done = cli("run", bag, *PLAIN, *extrinsics(), "--out", tmp_path / name)
        assert done.status == 0, done.err
        assert ("5 messages are joined to a scan of 0.1 s" in done.err) == (name == "parts")
        out[name] = np.load(tmp_path / name / "states.npz")
    assert len(out["whole"]["stamps_ns"]) == COUNT
    for key in ("stamps_ns", "poses", "velocity", "covariance"):
        np.testing.assert_array_equal(out["parts"][key], out["whole"][key])


def test_start_and_scans_count_sweeps(cli: Cli, tmp_path: Path, whole: Path, in_parts: Path) -> None:
    stamps = {}
    for name, bag in (("whole", whole), ("parts", in_parts)):
        words = ("--start", 3, "--scans", 4, "--out", tmp_path / name)
        assert cli("run", bag, *PLAIN, *extrinsics(), *words).status == 0
        stamps[name] = np.load(tmp_path / name / "states.npz")["stamps_ns"]
        behind = cli("run", bag, *PLAIN, "--start", COUNT, "--out", tmp_path / "none")
        assert behind.status == 2
        assert f"holds {COUNT} scans" in behind.err
    assert len(stamps["whole"]) == 4
    np.testing.assert_array_equal(stamps["parts"], stamps["whole"])
    span = Span(open_sequence(in_parts), 3, 4)
    assert span.info.scan_count == len(list(span.scans())) == 4


def test_lost_messages_leave_the_poses_where_they_are(cli: Cli, tmp_path: Path) -> None:
    """Five of 60 messages are lost, each of another sweep."""
    bag = bags.write_bag(tmp_path / "drive.mcap", _messages(5, lost=(6, 18, 33, 47, 54)))
    write_tum(tmp_path / "truth.tum", truth())
    words = ("--gt", tmp_path / "truth.tum", "--out", tmp_path / "out")
    done = cli("run", bag, *PLAIN, *extrinsics(), *words)
    assert done.status == 0, done.err
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["scans"] == COUNT
    assert metrics["failures"] == []
    # as whole sweeps: tests/commands/test_readers.py
    assert metrics["ate"]["rmse"] < 0.026


def test_inspect_counts_scans_and_names_the_messages(cli: Cli, whole: Path, in_parts: Path) -> None:
    found = {bag: json.loads(cli("inspect", bag, "--json").out) for bag in (whole, in_parts)}
    for key in ("scans", "scan_rate", "points_per_scan", "rings"):
        assert found[in_parts][key] == found[whole][key]
    assert found[in_parts]["topics"][0]["messages"] == 5 * COUNT
    printed = cli("inspect", in_parts).out
    assert "5 messages are joined to a scan of 0.1 s" in printed
    assert "--set config.data.messages_per_scan=1 reads each message as a scan" in " ".join(printed.split())


def test_messages_are_scans_where_the_settings_say_so(cli: Cli, tmp_path: Path, in_parts: Path) -> None:
    words = ("config.data.messages_per_scan=1", "--scans", 10, "--out", tmp_path / "out")
    done = cli("run", in_parts, *PLAIN, *extrinsics(), *words)
    assert done.status in (0, 1)
    assert "joined" not in done.err
    assert open_sequence(in_parts, DataConfig(messages_per_scan=1)).info.scan_count == 5 * COUNT


def test_tune_reads_whole_sweeps(cli: Cli, tmp_path: Path, whole: Path, in_parts: Path) -> None:
    values = {}
    write_tum(tmp_path / "truth.tum", truth())
    scored = ("--objective", "ate", "--gt", tmp_path / "truth.tum")
    for name, bag in (("whole", whole), ("parts", in_parts)):
        words = ("--params", "registration.kernel", "--iterations", 1, "--out", tmp_path / name)
        done = cli("tune", bag, *words, *scored, "--set", *extrinsics())
        assert done.status == 0, done.err
        values[name] = (tmp_path / name / "tuned.yaml").read_text()
    assert values["parts"] == values["whole"].replace(str(whole), str(in_parts))
