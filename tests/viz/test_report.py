"""A run's report holds its figures and numbers, and nothing that a name could smuggle in."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from lio_jax.cli import main
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.viz.report import write_comparison, write_report
from lio_jax.viz.run_figures import map_png, nis_band
from tests.viz.browser import needs_browser, opened
from tests.viz.run_folders import write_run
from tests.viz.test_html import EVIL

FIGURES = [
    "Map from above",
    "Way from above",
    "From the side",
    "Position error over distance",
    "Attitude error over distance",
    "Position error over time",
    "Attitude error over time",
    "Relative position error",
    "Relative attitude error",
    "Gyroscope bias",
    "Accelerometer bias",
    "Sigma of the position",
    "Sigma of the attitude",
    "Normalised innovation squared",
    "Matches",
    "Residual of the match",
    "Solve",
    "Speed",
    "Time of each scan",
    "Time by stage",
]


def titles(text: str) -> list[str]:
    return re.findall(r"<h3>([^<]*)</h3>", text)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "run")


def test_every_figure_is_there(folder):
    text = write_report(folder).read_text()
    assert titles(text) == FIGURES
    assert text.count("<svg") == len(FIGURES)
    assert "no values" not in text


def test_numbers_complaints_and_settings_are_there(folder):
    text = write_report(folder).read_text()
    for said in (
        "0.05 m",
        "scan 7: 3 points matched the map.",
        "the clock stepped back.",
        "T_imu_lidar: from the recording.",
        "voxel_size",
        "0.10.2",
        "90 % of the scans lie within the 95 % band",
        "Aligned by least squares; rmse 0.05 m.",
    ):
        assert said in text, said


def test_without_inertial_samples_and_truth_their_figures_are_left_out(tmp_path):
    text = write_report(write_run(tmp_path / "run", inertial=False, truth=False)).read_text()
    absent = {"Position error over distance", "Relative position error", "Gyroscope bias"}
    assert not absent & set(titles(text))
    assert {"Way from above", "Sigma of the position", "Time of each scan"} <= set(titles(text))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_shortest_runs_have_reports(tmp_path, count):
    metrics = {"failures": [], "warnings": []}
    folder = write_run(tmp_path / "run", 8, metrics=metrics)
    for name in ("states.npz", "scans.npz"):
        columns = dict(np.load(folder / name))
        np.savez(folder / name, **{key: values[:count] for key, values in columns.items()})
    assert "Way from above" in titles(write_report(folder).read_text())


def test_a_diverged_run_has_a_report(tmp_path):
    folder = write_run(tmp_path / "run")
    states = dict(np.load(folder / "states.npz"))
    states["poses"][30:] = np.nan
    states["covariance"][10:] = np.nan
    np.savez(folder / "states.npz", **states)
    text = write_report(folder).read_text()
    assert "Position error over distance" in titles(text)
    assert "NaN" not in text
    assert "nan" not in re.sub(r"[a-z]nan|nan[a-z]", "", text)


def test_names_are_text(tmp_path):
    folder = write_run(tmp_path / "run", name=EVIL, metrics={"warnings": [EVIL], "environment": {EVIL: EVIL}})
    text = write_report(folder).read_text()
    assert "<script" not in text
    assert text.count("&lt;script&gt;") >= 5


def test_truth_of_another_time_is_reported(tmp_path):
    folder = write_run(tmp_path / "run")
    (folder / "truth.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    text = write_report(folder).read_text()
    assert "The truth is not shown. No pose of the estimate lies in the time span of the truth" in text


@pytest.mark.parametrize("name", ["states.npz", "metrics.json", "config.yaml", "scans.npz"])
def test_damaged_files_are_named(tmp_path, name):
    folder = write_run(tmp_path / "run")
    (folder / name).write_bytes(b"{ not this")
    with pytest.raises(LioJaxError, match=re.escape(str(folder / name))):
        write_report(folder)


def test_a_folder_of_something_else_is_refused(tmp_path):
    with pytest.raises(LioJaxError, match="give a folder that lio-jax run wrote"):
        write_report(tmp_path)


def test_size_does_not_follow_the_length(tmp_path):
    long = len(write_report(write_run(tmp_path / "long", 10_000)).read_text())
    longer = len(write_report(write_run(tmp_path / "longer", 40_000)).read_text())
    assert longer < 1.2 * long < 1_000_000


def test_bands_are_those_of_chi_square():
    low, high = nis_band(np.array([6, 0, 3, 6]))
    # chi-square table: 2.5 and 97.5 % of 6 and of 3 degrees of freedom
    np.testing.assert_allclose(low, [1.2373, np.nan, 0.2158, 1.2373], atol=1e-4)
    np.testing.assert_allclose(high, [14.4494, np.nan, 9.3484, 14.4494], atol=1e-4)


def test_map_picture_shows_points_where_they_are(tmp_path):
    from matplotlib.image import imread

    points = np.array([[1.5, 0.5, 0.0], [1.5, 0.5, 2.0], [3.5, 1.5, 0.0], [99.0, 0.0, 0.0]])
    (tmp_path / "map.png").write_bytes(map_png(points, (0.0, 4.0), (0.0, 2.0), 4))
    opacity = imread(tmp_path / "map.png")[:, :, 3]
    assert opacity.shape == (2, 4)
    assert list(zip(*np.nonzero(opacity), strict=True)) == [(0, 3), (1, 1)]
    assert opacity[1, 1] > opacity[0, 3]


def test_runs_are_compared(tmp_path, folder):
    other = write_run(tmp_path / "other", changes={"params.map.voxel_size": 0.75}, inertial=False)
    write_comparison([folder, other], tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert titles(text) == [
        "From above",
        "From the side",
        "Position error over distance",
        "Relative position error",
        "Relative attitude error",
        "Time of a scan",
    ]
    rows = re.findall(r"<tr><td>(params[^<]*|config[^<]*)</td>", text)
    assert rows == ["params.map.voxel_size"]
    assert "0.75" in text


def test_a_run_is_not_compared_with_itself(folder, tmp_path):
    with pytest.raises(UsageError, match="given twice"):
        write_comparison([folder, folder], tmp_path / "page.html")


def test_the_command_writes_to_the_given_path(folder, tmp_path, capsys):
    other = write_run(tmp_path / "other")
    (other / "report.html").unlink(missing_ok=True)
    assert main(["report", str(other)]) == 0
    assert (other / "report.html").is_file()
    assert main(["report", str(other), str(folder), "--out", str(tmp_path / "both.html")]) == 0
    assert capsys.readouterr().out.splitlines() == [str(other / "report.html"), str(tmp_path / "both.html")]
    assert main(["report", str(other), str(folder)]) == 2
    assert "--out FILE.html" in capsys.readouterr().err


@needs_browser
def test_a_browser_shows_the_page_and_asks_for_nothing(folder, tmp_path, pictures):
    from matplotlib.image import imread

    page = opened(write_report(folder), tmp_path)
    assert page.console == []
    assert page.requested == []
    assert page.document.count("<figure") == page.document.count("</svg>") == len(FIGURES)
    picture = imread(page.picture)
    shutil.copy(page.picture, pictures / "report.png")
    # the map's figure, in the page's upper half: paper, grid, points, two coloured ways
    assert len(np.unique((picture[600:1200, :, :3] * 31).astype(int).reshape(-1, 3), axis=0)) > 20


@needs_browser
def test_the_browser_would_tell_of_a_page_that_asks_outside(tmp_path):
    page = tmp_path / "page.html"
    page.write_text("<script>console.error('heard')</script><img src='http://127.0.0.1:9/picture.png'>")
    seen = opened(page, tmp_path)
    assert any("heard" in line for line in seen.console)
    assert seen.requested == ["http://127.0.0.1:9/picture.png"]


def test_metrics_of_an_older_run_do(tmp_path):
    folder = write_run(tmp_path / "run")
    (folder / "metrics.json").write_text(json.dumps({"scans": 60, "failures": []}))
    (folder / "scans.npz").unlink()
    assert {"Way from above", "Gyroscope bias"} <= set(titles(write_report(folder).read_text()))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("scans.npz", lambda arrays: {"step_ms": arrays["step_ms"] > 0}),
        ("scans.npz", lambda arrays: {"failed": arrays["failed"][:-1]}),
        ("states.npz", lambda arrays: {"velocity": arrays["velocity"][:, :2]}),
        ("states.npz", lambda arrays: {"stamps_ns": arrays["stamps_ns"].astype(float)}),
    ],
)
def test_columns_of_another_form_are_refused(tmp_path, name, change):
    run = write_run(tmp_path / "run")
    with np.load(run / name) as file:
        arrays = dict(file)
    changed = change(arrays)
    np.savez(run / name, **(arrays | changed))
    with pytest.raises(LioJaxError, match=rf"{name}: cannot be read \({next(iter(changed))} is an array"):
        write_report(run)


@pytest.mark.parametrize(
    ("metrics", "problem"),
    [
        ([], "the whole is no object"),
        ({"verdict": {"state": "sound"}}, "verdict lacks since_s"),
        ({"backend": {"keyframes": "a", "loops": {}}}, "backend lacks gps"),
        ({"warnings": 3}, "warnings is no list"),
        ({"failures": [{}]}, "an entry of failures lacks message"),
        ({"wall_s": None}, "wall_s is 'None'"),
    ],
)
def test_metrics_of_another_form_are_refused(tmp_path, metrics, problem):
    run = write_run(tmp_path / "run")
    (run / "metrics.json").write_text(json.dumps(metrics))
    with pytest.raises(LioJaxError, match=rf"metrics\.json: cannot be read \({problem}\); run again"):
        write_report(run)


@pytest.mark.parametrize("text", ["a: [\n", "", "- 1"])
def test_a_configuration_that_is_none_is_refused_in_one_line(tmp_path, text):
    run = write_run(tmp_path / "run")
    (run / "config.yaml").write_text(text)
    with pytest.raises(LioJaxError, match=r"config\.yaml: cannot be read \([^\n]*\); run again\.$"):
        write_report(run)


def test_a_version_that_is_a_number_is_shown(tmp_path):
    run = write_run(tmp_path / "run")
    metrics = json.loads((run / "metrics.json").read_text()) | {"environment": {"jaxlib": 123456}}
    (run / "metrics.json").write_text(json.dumps(metrics))
    assert "123456" in write_report(run).read_text()


def test_a_description_of_another_type_is_shown(tmp_path):
    run = write_run(tmp_path / "run")
    metrics = json.loads((run / "metrics.json").read_text()) | {"recording": {"format": ["a bag"], "path": 3}}
    (run / "metrics.json").write_text(json.dumps(metrics))
    assert "a bag" in write_report(run).read_text()
