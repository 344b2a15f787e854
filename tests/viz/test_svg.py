"""Charts show the values they are given, at the places their axes say."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from lio_jax.viz.svg import (
    WIDTH,
    Line,
    axes_of,
    box_chart,
    equal_axes,
    line_chart,
    plan_chart,
    round_ticks,
    stack_chart,
)


def parsed(svg: str) -> ET.Element:
    return ET.fromstring(svg)


def curves(svg: str) -> list[list[np.ndarray]]:
    """Return the points of each curve's pieces, drawing units."""
    found = []
    for path in parsed(svg).iter("path"):
        if "curve" in path.get("class", ""):
            pieces = [piece for piece in path.get("d", "").split("M") if piece]
            found.append([np.array([p.split() for p in piece.split("L")], float) for piece in pieces])
    return found


def labels(svg: str) -> list[str]:
    return [text.text or "" for text in parsed(svg).iter("text")]


def test_a_curve_passes_through_its_values():
    x, y = np.array([0.0, 1.0, 4.0]), np.array([10.0, -5.0, 20.0])
    axes = axes_of([x], [y])
    [[points]] = curves(line_chart([Line(x, y)], "x [m]", "y [m]"))
    np.testing.assert_allclose(points, np.c_[axes.x(x), axes.y(y)], atol=0.051)
    assert {"x [m]", "y [m]"} <= set(labels(line_chart([Line(x, y)], "x [m]", "y [m]")))


def test_ticks_stand_where_their_numbers_are():
    x, y = np.array([0.0, 10.0]), np.array([0.0, 0.004])
    axes = axes_of([x], [y])
    svg = parsed(line_chart([Line(x, y)], "x", "y"))
    for text in svg.iter("text"):
        if text.get("text-anchor") == "end":
            assert float(text.get("y")) - 4 == pytest.approx(axes.y(np.array([float(text.text)]))[0], abs=0.1)


def test_missing_values_interrupt_a_curve():
    y = np.array([1.0, 2.0, np.nan, np.inf, 3.0, 4.0])
    [pieces] = curves(line_chart([Line(np.arange(6.0), y)], "x", "y"))
    assert [len(piece) for piece in pieces] == [2, 2]


def test_long_curves_keep_their_extremes_and_little_else():
    y = np.random.default_rng(0).normal(size=200_000)
    y[123_456] = 50.0
    svg = line_chart([Line(np.arange(200_000.0), y)], "x", "y")
    assert len(svg) < 30_000
    [[points]] = curves(svg)
    axes = axes_of([np.arange(200_000.0)], [y])
    assert points[:, 1].min() == pytest.approx(axes.y(np.array([50.0]))[0], abs=0.06)


def test_long_paths_keep_their_form():
    angle = np.linspace(0, 8 * np.pi, 100_000)
    path = Line(np.cos(angle), np.sin(angle))
    axes = equal_axes([path.x], [path.y])
    [[points]] = curves(plan_chart(axes, [path], "x", "y"))
    assert len(points) <= 4000
    radius = (axes.x(np.array([1.0])) - axes.x(np.array([-1.0])))[0] / 2
    centre = [axes.x(np.zeros(1))[0], axes.y(np.zeros(1))[0]]
    np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), radius, atol=0.6)


@pytest.mark.parametrize("spans", [(100.0, 1.0), (1.0, 100.0), (0.0, 0.0), (3.0, 3.0)])
def test_plans_are_to_scale_and_hold_everything(spans):
    x, y = np.array([0.0, spans[0]]), np.array([0.0, spans[1]])
    axes = equal_axes([x], [y], width=WIDTH)
    across = (axes.right - axes.left) / (axes.x_high - axes.x_low)
    upright = (axes.bottom - axes.top) / (axes.y_high - axes.y_low)
    assert across == pytest.approx(upright)
    assert axes.x_low <= 0.0 <= spans[0] <= axes.x_high
    assert axes.y_low <= 0.0 <= spans[1] <= axes.y_high


def test_logarithmic_scale_leaves_out_what_has_no_logarithm():
    svg = line_chart([Line(np.arange(4.0), np.array([0.01, -1.0, 1.0, 100.0]))], "x", "y", log=True)
    [pieces] = curves(svg)
    assert [len(piece) for piece in pieces] == [2, 2]
    low, middle, high = pieces[0][0, 1], pieces[1][0, 1], pieces[1][1, 1]
    assert low - middle == pytest.approx(middle - high, abs=0.2)
    assert {"0.01", "1", "100"} <= set(labels(svg))


def test_boxes_stand_at_the_quartiles():
    values = np.arange(101.0)
    box = parsed(box_chart({"a": values, "b": np.full(3, np.nan)}, "y")).find(".//rect")
    axes = axes_of([np.array([0.0, 1.0])], [values], from_zero=True)
    top, bottom = axes.y(np.array([75.0, 25.0]))
    assert float(box.get("y")) == pytest.approx(top, abs=0.06)
    assert float(box.get("height")) == pytest.approx(bottom - top, abs=0.11)
    assert "a" in labels(box_chart({"a": values}, "y"))
    assert "b" not in labels(box_chart({"a": values, "b": np.full(3, np.nan)}, "y"))


def test_layers_of_a_stack_add_up():
    svg = parsed(stack_chart({"a": np.full(5, 1.0), "b": np.full(5, 2.0)}, np.arange(5.0), "x", "y"))
    areas = [path.get("d") for path in svg.iter("path") if path.get("class") == "area"]
    edges = [{float(number.split()[1]) for number in re.findall(r"[\d.]+ [\d.]+", area)} for area in areas]
    assert len(edges[0] & edges[1]) == 1
    axes = axes_of([np.arange(5.0)], [np.array([0.0, 3.3])], from_zero=True)
    assert min(edges[1]) == pytest.approx(axes.y(np.array([3.0]))[0], abs=0.06)


@pytest.mark.parametrize("values", [np.zeros(0), np.full(3, np.nan)])
def test_a_chart_without_data_states_that_it_has_no_values(values):
    x = np.arange(float(len(values)))
    assert "no values" in labels(line_chart([Line(x, values)], "x", "y"))
    assert "no values" in labels(box_chart({"a": values}, "y"))
    assert "no values" in labels(stack_chart({}, x, "x", "y"))


def test_ticks_are_round_and_within():
    for low, high in ((0.0, 1.0), (-3.7, 12.2), (1e-7, 3e-7), (1e6, 1e6 + 3)):
        ticks = round_ticks(low, high)
        assert 2 <= len(ticks) <= 7
        assert ticks[0] >= low - 1e-9 * abs(low)
        assert ticks[-1] <= high * (1 + 1e-12)


@pytest.mark.parametrize("constant", [0.0, 5.0, -1e-9, 1e9])
def test_constants_have_axes_of_some_size(constant):
    assert curves(line_chart([Line(np.arange(3.0), np.full(3, constant))], "x", "y"))
