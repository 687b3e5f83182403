"""The still pictures of plots: what stands in their SVG."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.report.bars import Bar, lying_bars, standing_bars
from agent.report.figures import cell_map, motion_box_plot
from agent.report.plots import Panel, Plot, Series
from agent.report.stills import still
from agent.report.svg import dates, ticks

T = np.linspace(0.0, 6.0, 1001)
CURVE = Series("speed <v>", np.sin(T))
SVG = "{http://www.w3.org/2000/svg}"


def plot(*series: Series, **options: object) -> Plot:
    return Plot("cycle", "One cycle.", "time", (Panel("tool", "m/s", series, **options),), T, "s")


def paths(text: str, colour: str) -> list[str]:
    """Ways of the drawn parts of a colour."""
    drawn = ElementTree.fromstring(text).iter(f"{SVG}path")
    return [path.get("d") for path in drawn if colour in (path.get("stroke"), path.get("fill"))]


def places(way: str) -> np.ndarray:
    return np.array(re.findall(r"[ML](-?[\d.]+) (-?[\d.]+)", way), dtype=float)


def texts(text: str) -> list[str]:
    return [found.text or "" for found in ElementTree.fromstring(text).iter(f"{SVG}text")]


def test_a_curve_is_where_its_values_are():
    (way,) = paths(still(plot(CURVE)), CURVE.colour)
    x, y = places(way).T
    assert np.all(np.diff(x) >= 0)
    high, low = y.argmin(), y.argmax()  # the picture's y grows downwards
    assert (x[high] - x[0]) / (x[-1] - x[0]) == pytest.approx(np.pi / 2 / 6, abs=0.01)
    assert (x[low] - x[0]) / (x[-1] - x[0]) == pytest.approx(3 * np.pi / 2 / 6, abs=0.01)


def test_axes_units_and_labels_are_there_and_are_text():
    other = replace(CURVE, label="planned", look="dashed", colour="#d55e00")
    shown = texts(still(plot(CURVE, other, marks={"limit": 1.5})))
    assert {"tool", "[m/s]", "time [s]", "speed <v>", "planned", "limit", "-1.0", "0.0", "6"} <= set(shown)


@pytest.mark.parametrize(
    ("title", "above"), [("joint_2", False), ("joint_2, 20261122T183433Z_arm/validation_01", True)]
)
def test_a_title_too_long_to_stand_beside_the_legend_stands_above_it(title, above):
    pair = (CURVE, replace(CURVE, label="with the effects"))
    panels = tuple(Panel(title, "m/s", pair) for _ in range(2))
    picture = ElementTree.fromstring(still(Plot("cycle", "Two.", "time", panels, T, "s", columns=2)))
    heights = {text.text: float(text.get("y")) for text in reversed([*picture.iter(f"{SVG}text")])}
    assert (heights[title] < heights["with the effects"] - 5.0) == above


def test_nothing_is_drawn_where_nothing_is_known():
    values = np.where((T > 2.0) & (T < 3.0), np.nan, np.sin(T))
    band = Series("band", values + 1.0, colour="#009e73", low=values - 1.0)
    picture = still(plot(replace(CURVE, values=values), band))
    line, area = paths(picture, CURVE.colour)[-1], paths(picture, "#009e73")[-1]
    assert (line.count("M"), area.count("M"), area.count("Z")) == (2, 2, 2)
    assert "nan" not in picture
    assert "nan" not in still(plot(replace(CURVE, values=np.full(len(T), np.nan))))


def test_parts_are_stacked():
    parts = [Series(name, np.ones(len(T)), "part", colour) for name, colour in (("a", "#111111"), ("b", "#222222"))]
    (first,), (second,) = (paths(still(plot(*parts, from_zero=True)), one.colour)[:1] for one in reversed(parts))
    assert places(first)[:, 1].max() == pytest.approx(places(second)[:, 1].min())


def test_two_pictures_of_a_page_share_no_id():
    one, other = still(plot(CURVE)), still(replace(plot(CURVE), name="other"))
    assert not set(re.findall(r'id="([^"]*)"', one)) & set(re.findall(r'id="([^"]*)"', other))


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(1, 12))
def test_ticks_are_round_few_and_inside(low, size, most):
    found = ticks(low, low + size, most)
    assert len(found) <= most + 1
    assert all(low - 1e-6 * size <= value <= low + size * (1 + 1e-6) for value, _ in found)
    steps = np.diff([value for value, _ in found])
    assert np.allclose(steps, steps[:1].repeat(len(steps)), rtol=1e-3)


def test_dates_are_told_as_finely_as_they_lie_apart():
    day = 1_700_006_400.0
    assert [text for _, text in dates(day, day + 40.0, 4)] == [
        f"00:00:{second}" for second in ("00", "10", "20", "30", "40")
    ]
    assert [text for _, text in dates(day, day + 3 * 86400.0, 4)] == [
        f"2023-11-{number}" for number in (15, 16, 17, 18)
    ]


def test_a_bar_is_as_long_as_its_value_and_says_it():
    bars = [Bar(0, 0.0, 2.0, "#111111"), Bar(1, 2.0, 6.0, "#222222"), Bar(2, 0.0, np.nan, "#333333")]
    picture = ElementTree.fromstring(lying_bars(["a", "b <c>", "d"], ["a: 2", "b: 4", "none"], bars, "error [%]"))
    rectangles = {found.get("fill"): found for found in picture.iter(f"{SVG}rect")}
    first, second = rectangles["#111111"], rectangles["#222222"]
    assert float(second.get("width")) == pytest.approx(2 * float(first.get("width")), abs=0.2)
    end = float(first.get("x")) + float(first.get("width"))
    assert float(second.get("x")) == pytest.approx(end, abs=0.2)
    assert "#333333" not in rectangles
    assert [title.text for title in picture.iter(f"{SVG}title")] == ["a: 2", "b: 4", "none"]


def test_standing_bars_go_both_ways():
    values = np.array([3.0, -1.5])
    picture = standing_bars(["up", "down"], ["u", "d"], values, ["#111111", "#222222"], "change", 5.0, (3.3,))
    up, down = (
        next(found for found in ElementTree.fromstring(picture).iter(f"{SVG}rect") if found.get("fill") == colour)
        for colour in ("#111111", "#222222")
    )
    assert float(up.get("height")) == pytest.approx(2 * float(down.get("height")), abs=0.2)
    assert float(up.get("y")) + float(up.get("height")) == pytest.approx(float(down.get("y")), abs=0.2)


def test_what_is_far_from_the_box_is_a_dot():
    rmse = np.append(np.linspace(0.9, 1.1, 20), 9.0)[:, None]
    figure = motion_box_plot(rmse, np.array([np.nan]), ("joint_1",), 0.03, "")
    assert figure.svg.count("stroke-linecap") == 1
    assert "joint_1: median 1" in figure.svg
    assert motion_box_plot(rmse[:-1], np.array([np.nan]), ("joint_1",), 0.03, "").svg.count("stroke-linecap") == 0


def test_a_map_shades_by_the_largest_of_the_same_unit():
    values = np.array([[1.0, np.nan], [0.25, 0.5]])
    svg = cell_map("cells", "", values, ["slow", "fast"], ["joint_1", "joint_2"], ["%", "N·m"]).svg
    shades = [float(found.get("fill-opacity")) for found in ElementTree.fromstring(svg).iter(f"{SVG}rect")]
    assert shades == [0.9, pytest.approx(0.49), 0.9]
