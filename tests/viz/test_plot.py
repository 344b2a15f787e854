import struct
import subprocess
import sys

import numpy as np
import pytest

from lio_jax.data.trajectory import Trajectory
from lio_jax.viz import plot
from lio_jax.viz.plot import plot_timings, plot_trajectory
from tests.evaluation.scenes import stamped, straight_drive, transform, winding_drive


@pytest.fixture
def drawn(monkeypatch):
    """Keep the figures that are saved, so that a test can ask what is on them."""
    figures = []
    save = plot._save

    def keep(figure, path):
        save(figure, path)
        figures.append(figure)

    monkeypatch.setattr(plot, "_save", keep)
    return figures


def png_size(path) -> tuple[int, int]:
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", header[16:24])


def panels(figure) -> dict[str, object]:
    return {axes.get_title().split(",")[0]: axes for axes in figure.axes}


def test_top_view_is_to_scale_and_shows_truth_where_the_estimate_is(tmp_path, drawn):
    truth = stamped(winding_drive())
    world = transform((0.1, 0.2, 2.0), (500.0, -200.0, 30.0))
    estimate = Trajectory(truth.stamp_ns, np.linalg.inv(world) @ truth.poses)
    plot_trajectory(tmp_path / "a.png", estimate, truth, "a drive")
    assert min(png_size(tmp_path / "a.png")) > 500
    axes = panels(drawn[0])
    assert set(axes) == {"from above", "height", "error"}
    top = axes["from above"]
    box = top.get_window_extent()
    (left, right), (bottom, upper) = top.get_xlim(), top.get_ylim()
    assert box.width / (right - left) == pytest.approx(box.height / (upper - bottom), rel=1e-3)
    assert "[m]" in top.get_xlabel()
    lines = {line.get_label(): line.get_xydata() for line in top.get_lines()}
    np.testing.assert_allclose(lines["truth, aligned"], lines["estimate"], atol=1e-6)


def test_error_is_the_distance_after_alignment(tmp_path, drawn):
    truth = stamped(np.tile(np.eye(4), (10, 1, 1)))
    estimate = stamped(np.tile(np.eye(4), (10, 1, 1)))
    estimate.poses[:, 0, 3] = 0.001 * np.arange(10)
    plot_trajectory(tmp_path / "a.png", estimate, truth, "standing")
    line = panels(drawn[0])["error"].get_lines()[0]
    np.testing.assert_allclose(line.get_ydata(), 0.001 * np.arange(10), atol=1e-12)
    np.testing.assert_allclose(line.get_xdata(), 0.1 * np.arange(10), atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 50])
def test_standing_vehicle_has_axes_of_some_size(tmp_path, drawn, count):
    still = stamped(np.tile(transform((0, 0, 0.3), (5.0, 6.0, 7.0)), (count, 1, 1)))
    plot_trajectory(tmp_path / "a.png", still, None, "standing")
    axes = panels(drawn[0])
    assert set(axes) == {"from above", "height"}
    for panel, centre in ((axes["from above"], 6.0), (axes["height"], 7.0)):
        low, high = panel.get_ylim()
        assert low < centre < high
        assert high - low >= 0.0099


def test_straight_and_long_drive(tmp_path):
    long_drive = stamped(straight_drive(50_000))
    plot_trajectory(tmp_path / "a.png", long_drive, long_drive, "50 km")
    assert min(png_size(tmp_path / "a.png")) > 500


def test_truth_of_other_times_is_left_out_and_reported(tmp_path, drawn):
    estimate, truth = stamped(winding_drive(20), 0), stamped(winding_drive(20))
    plot_trajectory(tmp_path / "a.png", estimate, truth, "no overlap")
    assert set(panels(drawn[0])) == {"from above", "height"}
    assert "Truth is not shown" in drawn[0].get_supxlabel()


def test_poses_that_are_not_finite_do_not_hinder(tmp_path):
    poses = winding_drive(20)
    poses[10:] = np.nan
    plot_trajectory(tmp_path / "a.png", stamped(poses), stamped(winding_drive(20)), "diverged")
    assert min(png_size(tmp_path / "a.png")) > 500


def test_timings_show_the_median_and_name_what_lies_beyond(tmp_path, drawn):
    total = np.full(200, 20.0)
    total[0] = 5_000.0
    plot_timings(tmp_path / "t.png", {"total": total, "registration": total / 4})
    over_scans, summary = drawn[0].axes
    assert over_scans.get_ylim()[1] < 100.0
    assert over_scans.get_title() == "time of each scan (2 off the scale)"
    assert [label.get_text() for label in summary.get_yticklabels()] == ["total\n20 ms", "registration\n5 ms"]


def test_timings_of_nothing_and_of_missing_values(tmp_path):
    plot_timings(tmp_path / "none.png", {})
    plot_timings(tmp_path / "nan.png", {"total": np.array([np.nan, 3.0]), "unused": np.array([np.nan])})
    plot_timings(tmp_path / "zero.png", {"total": np.zeros(3)})
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["nan.png", "none.png", "zero.png"]


def test_pyplot_is_not_imported(tmp_path):
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from lio_jax.viz.plot import plot_timings\n"
        "assert 'matplotlib' not in sys.modules\n"
        "plot_timings(Path(sys.argv[1]), {'total': [1.0, 2.0]})\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "t.png")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("name", [r"run $1 and $\frac{", "маршрут 测试", "line\nbreak"])
def test_any_name_is_a_title(tmp_path, drawn, name):
    plot_trajectory(tmp_path / "a.png", stamped(straight_drive()), None, name)
    assert drawn[0].get_suptitle() == name
