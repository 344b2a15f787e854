"""The fuzz campaign: a short one finds nothing, and its judge, its watch and its shortening work."""

import os
import sys
from io import BytesIO
from pathlib import Path
from random import Random

import numpy as np
import pytest

from experiments.fuzz import campaign
from experiments.fuzz.__main__ import main
from experiments.fuzz.campaign import Failure, Trial, Worker, failure_from_json, run_campaign, signature
from experiments.fuzz.edits import ARRAY_ACTIONS, VALUE_ACTIONS, Edit
from experiments.fuzz.kinds import KINDS
from experiments.fuzz.layouts import NUMBERS
from experiments.fuzz.verdicts import ACCEPTED, REFUSED, Done, Verdict, judge

SLOW = {"run", "run settings", "map", "report", "g2o", "rest"}
"""Kinds whose seeds or commands compile programs."""


def test_a_short_campaign_finds_nothing(tmp_path):
    names = tuple(kind.name for kind in KINDS if kind.name not in SLOW)
    found = run_campaign(tmp_path, 2 * len(names), kinds=names)
    assert found.failures == {}, found.table()
    table = found.table()
    assert "traceback" in table
    assert f"{2 * len(names)} inputs in" in table
    for counts in found.verdicts.values():
        assert counts["inputs"] == 2
        assert counts[ACCEPTED] + counts[REFUSED] == 2


def verdict_on(folder, ends="", may_be_nan=(), **done):
    given = {"status": 0, "out": "", "err": ""} | done
    return judge(Done(**given), folder / "in", folder / "out", 1000, ends, may_be_nan).name


def test_judge(tmp_path):
    (tmp_path / "out").mkdir()
    refusal = f"lio-jax: {tmp_path}/in/a.bag: is empty; record it again.\n"
    assert verdict_on(tmp_path) == ACCEPTED
    assert verdict_on(tmp_path, status=1, err=f"note: so.\n{refusal}") == REFUSED
    assert verdict_on(tmp_path, status=1, err="lio-jax: it is empty; record it again.\n") == "unclear"
    assert verdict_on(tmp_path, status=1, err=refusal.replace(";", " (MemoryError);")) == "unclear"
    assert (
        verdict_on(tmp_path, status=1, err="lio-jax: unexpected KeyError: 'a'; report it.\n") == "unexpected"
    )
    assert verdict_on(tmp_path, status=1, err="Traceback (most recent call last):\n") == "traceback"
    assert verdict_on(tmp_path, err="a.py:3: RuntimeWarning: overflow\n") == "stray"
    assert verdict_on(tmp_path, status=None, ended="hang") == "hang"
    assert verdict_on(tmp_path, grown=1001) == "memory"
    assert verdict_on(tmp_path, outside=("open /etc/passwd",)) == "outside"
    assert verdict_on(tmp_path, out="ATE nan m\n") == "not finite"
    assert verdict_on(tmp_path, out='{"duration": Infinity}') == "not finite"
    assert (
        verdict_on(tmp_path, out='{"problems": ["scan 2: its duration (inf s) is impossible."]}') == ACCEPTED
    )
    assert verdict_on(tmp_path, out="scan 2: its duration (inf s) is impossible.\n") == ACCEPTED
    assert verdict_on(tmp_path, "is empty", status=1, err=refusal) == ACCEPTED


def test_judge_looks_into_results(tmp_path):
    (tmp_path / "out").mkdir()
    np.savez(tmp_path / "out" / "imu.npz", gyro=np.array([np.nan]))
    assert verdict_on(tmp_path) == "not finite"
    assert verdict_on(tmp_path, may_be_nan=("gyro",)) == ACCEPTED
    (tmp_path / "out" / "truth.tum").write_text("0 1 inf 3 0 0 0 1\n")
    assert verdict_on(tmp_path, may_be_nan=("gyro",)) == "not finite"


@pytest.fixture
def worker(tmp_path):
    made = Worker(tmp_path / "work")
    (tmp_path / "work").mkdir()
    yield made
    made.close()


@pytest.mark.long
def test_a_command_that_hangs_is_ended(worker, tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "a.tum")
    assert worker.run(["--version"], tmp_path).status == 0
    monkeypatch.setattr(campaign, "SILENCE_S", 0.3)
    # nobody ever writes to it
    done = worker.run(["eval", str(tmp_path / "a.tum"), str(tmp_path / "a.tum")], tmp_path)
    assert (done.status, done.ended) == (None, "hang")
    monkeypatch.setattr(campaign, "SILENCE_S", 60.0)
    assert worker.run(["--version"], tmp_path).status == 0
    monkeypatch.setattr(campaign, "MOST_BYTES", -(1 << 40))
    assert worker.run(["eval", str(tmp_path / "a.tum"), str(tmp_path / "a.tum")], tmp_path).ended == "memory"


def test_what_is_written_elsewhere_is_seen(worker, tmp_path):
    drive = tmp_path / "04"
    (drive / "velodyne").mkdir(parents=True)
    np.ones((5, 4), np.float32).tofile(drive / "velodyne" / "000000.bin")
    for name, allowed in (("a", tmp_path), ("b", tmp_path / "elsewhere")):
        words = ["export", str(drive), "--to", "native", "--out", str(tmp_path / name)]
        done = worker.run(words, allowed)
        assert done.status == 0, done.err
        assert bool(done.outside) == (name == "b")


def test_only_what_fails_is_kept(monkeypatch):
    edits = [Edit("a", "put", (place, "00")) for place in range(3)]
    seen = Verdict("unexpected", "lio-jax: unexpected KeyError: 'a'")
    trial = object.__new__(Trial)
    monkeypatch.setattr(
        Trial, "verdict", lambda self, kind, words, given: seen if edits[1] in given else Verdict(ACCEPTED)
    )
    assert trial.smaller(KINDS[0], ("export",), edits, seen) == [edits[1]]


def test_ways_of_failing():
    one = Verdict("unexpected", "lio-jax: unexpected KeyError: 'a' in /tmp/x at byte 17")
    other = Verdict("unexpected", "lio-jax: unexpected KeyError: 'b' in /tmp/y at byte 4")
    assert signature(one) == signature(other)
    assert signature(one) != signature(Verdict("stray", one.evidence))


def test_a_failure_comes_back_from_its_text():
    failure = Failure(
        "mcap", ("export", "{in}/a"), [Edit("a", "tree", (["x", 1], "replace", None))], "hang", ""
    )
    assert failure_from_json(failure.to_json()) == failure


def test_the_same_seed_gives_the_same_damage(tmp_path):
    (tmp_path / "estimate.tum").write_text("0 1 2 3 0 0 0 1\n" * 9)
    kind = next(kind for kind in KINDS if kind.name == "tum")
    drawn = [kind.draw(tmp_path, Random(number)) for number in (7, 7, 8)]
    assert drawn[0] == drawn[1] != drawn[2]


def test_numbers_of_every_layout_lie_in_the_file(tmp_path):
    from tests.data import bags

    for name, layouts in (("a.bag", ("ros1", "messages")), ("a.mcap", ("mcap",)), ("a.db3", ("sqlite",))):
        folder = tmp_path / name[2:]
        folder.mkdir()
        path = bags.write_bag(folder / name, bags.velodyne_messages(2, bags.is_ros2(Path(name))))
        file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix == f".{name[2:]}")
        for layout in layouts:
            numbers = list(NUMBERS[layout](file.read_bytes()))
            assert len(numbers) > 50
            assert max(number.offset for number in numbers) > 5000


def test_numbers_of_a_las_header_decide_how_its_points_are_read():
    laspy = pytest.importorskip("laspy", reason="laspy is not installed; it comes with lio-jax[las]")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.add_extra_dims([laspy.ExtraBytesParams("ring", "u2"), laspy.ExtraBytesParams("time", "f4")])
    file = BytesIO()
    laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(7, header=header)).write(file)
    data = file.getvalue()
    numbers = {
        int.from_bytes(data[one.offset : one.offset + one.size], "little") for one in NUMBERS["las"](data)
    }
    uint16, float32 = 3, 9  # types of extra dimensions, LAS 1.4, table 24
    assert numbers >= {6, header.point_format.size, 7, len(data) - 7 * 36, 2 * 192, uint16, float32}


def test_actions_that_keep_the_form_of_an_array():
    for action in VALUE_ACTIONS:
        changed = ARRAY_ACTIONS[action](np.arange(20.0).reshape(10, 2))
        assert changed is not None
        assert (changed.shape, changed.dtype) == ((10, 2), np.float64)


def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ouster.sdk", None)
    monkeypatch.setattr(sys, "argv", ["fuzz", "--inputs", "2", "--work", str(tmp_path)])
    assert main() == 2
    assert "install it with pip install --no-deps 'ouster-sdk" in capsys.readouterr().err
