"""The comparison of benchmarks with the committed baseline, on numbers in place of measurements."""

import json
from dataclasses import replace

import pytest

from tests.experiments import bench_path  # noqa: F401

import bench_check  # isort: skip
from bench_check import BASELINE, CheckError, Figure, Measure  # isort: skip

RATIO = Measure("rows/graph=b/ms", "ratio", 2.0, 0.5, over="rows/graph=a/ms")
ERROR = Measure("rows/graph=b/ate", "m", 0.01, 0.1)
FIGURE = Figure("ours / theirs", "a_benchmark.py", ("json",), RATIO, ERROR)
OUTPUT = {"rows": [{"graph": "a", "ms": 3.0}, {"graph": "b", "ms": 6.0, "ate": 0.01}]}


def test_a_ratio_is_formed_within_one_run():
    assert bench_check.values_of(FIGURE, OUTPUT) == [2.0, 0.01]


@pytest.mark.parametrize(
    ("now", "moved"),
    [
        ([2.9, 0.0109], False),
        ([3.1, 0.01], True),
        ([2.0, 0.0112], True),
        ([0.1, 0.001], False),
        ([float("nan"), 0.01], True),
    ],
    ids=["within", "slower", "less accurate", "better", "not a number"],
)
def test_a_figure_moves_beyond_its_tolerance_in_the_bad_direction_alone(now, moved):
    table, names = bench_check.compared([FIGURE], {FIGURE.name: now})
    assert names == ([FIGURE.name] if moved else [])
    assert ("MOVED" in table) == moved


def test_a_figure_that_should_be_large_moves_downwards():
    high = replace(RATIO, better="higher")
    assert high.moved(0.9)
    assert not high.moved(5.0)


def test_a_figure_without_its_peer_is_skipped_in_a_sentence():
    wanted, skipped = bench_check.available([FIGURE, replace(FIGURE, needs=("no_such_peer",))])
    assert wanted == [FIGURE]
    assert skipped[0].startswith("skipped: ours / theirs (no_such_peer is not installed; pip install")


def test_unknown_figures_and_numbers_are_named():
    with pytest.raises(CheckError, match=r"no figure is called 'thiers'; there are: ours / theirs"):
        bench_check.chosen([FIGURE], ["thiers"])
    with pytest.raises(CheckError, match=r"'a_benchmark\.py' prints no number at 'rows/graph=b/ms'"):
        bench_check.values_of(FIGURE, {"rows": []})


def entry(**changed):
    ratio = {"at": "ratio", "unit": "ratio", "value": 1.0, "tolerance": 0.1, **changed}
    return json.dumps({"figures": [{"name": "one", "command": "one.py", "needs": [], "ratio": ratio}]})


@pytest.mark.parametrize(
    "text", ["", "[]", '{"figures": [{"name": 1}]}', entry(bettr="lower"), entry(better="larger")]
)
def test_a_broken_baseline_is_one_sentence(tmp_path, monkeypatch, capsys, text):
    path = tmp_path / "baseline.json"
    path.write_text(text)
    monkeypatch.setattr(bench_check, "BASELINE", path)
    monkeypatch.setattr("sys.argv", ["bench_check.py"])
    assert bench_check.main() == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "baseline.json: is no baseline" in error


@pytest.mark.parametrize(("ratio", "status"), [(2.0, 0), (6.1, 1)])
def test_the_exit_status_says_whether_a_figure_moved(tmp_path, monkeypatch, capsys, ratio, status):
    script, path = tmp_path / "one.py", tmp_path / "baseline.json"
    script.write_text(f"print('a table')\nprint('{json.dumps({'ratio': ratio})}')")
    path.write_text(entry(value=2.0).replace("one.py", str(script)))
    monkeypatch.setattr(bench_check, "BASELINE", path)
    monkeypatch.setattr("sys.argv", ["bench_check.py"])
    assert bench_check.main() == status
    monkeypatch.setattr("sys.argv", ["bench_check.py", "--update"])
    assert bench_check.main() == 0
    assert bench_check.baseline(path)[0].ratio.value == ratio


def test_a_benchmark_that_fails_is_named_with_its_last_line_and_the_others_go_on(tmp_path):
    broken, sound = tmp_path / "broken.py", tmp_path / "sound.py"
    broken.write_text("raise SystemExit('no room')")
    sound.write_text(f"print('{json.dumps(OUTPUT)}')")
    figures = [replace(FIGURE, command=str(broken)), replace(FIGURE, name="other", command=str(sound))]
    now, failed = bench_check.measured(figures)
    assert now == {"other": [2.0, 0.01]}
    assert failed == [f"'{broken}' failed with status 1: no room"]


def test_the_committed_baseline_names_benchmarks_that_exist():
    figures = bench_check.baseline(BASELINE)
    assert len({one.name for one in figures}) == len(figures)
    for one in figures:
        assert (BASELINE.parents[2] / one.command.split()[0]).is_file()
