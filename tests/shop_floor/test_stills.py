"""The still pictures of plots: what stands in their SVG."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.pages.calibration.prediction import error_table
from agent.pages.elements import Bar, Bars, Table, shaded_table, table_html
from agent.pages.plots import Panel, Plot, Series
from agent.pages.stills import dates, still, ticks

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
    return [part.strip() for part in ElementTree.fromstring(text).itertext()]


def test_a_curve_is_drawn_at_its_values():
    (way,) = paths(still(plot(CURVE)), CURVE.colour)
    x, y = places(way).T
    assert np.all(np.diff(x) >= 0)
    high, low = y.argmin(), y.argmax()  # the picture's y grows downwards
    assert (x[high] - x[0]) / (x[-1] - x[0]) == pytest.approx(np.pi / 2 / 6, abs=0.01)
    assert (x[low] - x[0]) / (x[-1] - x[0]) == pytest.approx(3 * np.pi / 2 / 6, abs=0.01)


def test_axes_units_and_labels_are_text():
    other = replace(CURVE, label="planned", look="dashed", colour="#d55e00")
    shown = texts(still(plot(CURVE, other, marks={"limit": 1.5})))
    assert {"tool", "[m/s]", "time [s]", "speed <v>", "planned", "limit", "-1.0", "0.0", "6"} <= set(shown)


def test_missing_values_are_not_drawn():
    values = np.where((T > 2.0) & (T < 3.0), np.nan, np.sin(T))
    band = Series("band", values + 1.0, colour="#009e73", low=values - 1.0)
    picture = still(plot(replace(CURVE, values=values), band))
    line, area = paths(picture, CURVE.colour)[-1], paths(picture, "#009e73")[-1]
    assert (line.count("M"), area.count("M"), area.count("Z")) == (2, 2, 2)
    assert "nan" not in picture
    assert "nan" not in still(plot(replace(CURVE, values=np.full(len(T), np.nan))))


def test_shares_are_stacked():
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


def test_date_labels_are_as_fine_as_their_spacing():
    day = 1_700_006_400.0
    assert [text for _, text in dates(day, day + 40.0, 4)] == [
        f"00:00:{second}" for second in ("00", "10", "20", "30", "40")
    ]
    assert [text for _, text in dates(day, day + 3 * 86400.0, 4)] == [
        f"2023-11-{number}" for number in (15, 16, 17, 18)
    ]


def rectangles(table: Table) -> list[dict[str, float]]:
    found = ElementTree.fromstring(table_html(table)).iter("rect")
    return [{key: float(one.get(key)) for key in ("x", "width")} for one in found]


def test_bars_of_one_unit_share_a_scale():
    spans = [(0.0, 2.0, "%"), (2.0, 6.0, "%"), (0.0, np.nan, "%"), (0.0, 60.0, "N·m"), (0.0, -30.0, "N·m")]
    rows = [("a <b>", Bars([Bar(begin, end, "#111111")], unit=unit)) for begin, end, unit in spans]
    first, second, torque, back = rectangles(Table("bars", ("what", "error"), rows))
    assert second["width"] == pytest.approx(2 * first["width"], abs=0.2)
    assert second["x"] == pytest.approx(first["x"] + first["width"], abs=0.2)
    assert torque["width"] == pytest.approx(2 * back["width"], abs=0.2)
    assert back["x"] + back["width"] == pytest.approx(torque["x"], abs=0.2), "bars go both ways from zero"


def test_an_outlier_is_drawn_apart_from_the_box():
    rmse = np.append(np.linspace(0.9, 1.1, 20), 9.0)[:, None]
    (row,) = error_table(rmse, np.array([np.nan]), ("joint_1",), 0.03, "").rows
    assert (row[0], row[3], row[6]) == ("joint_1", "1.01", "N·m")
    whiskers, box, far = row[7].bars
    assert (whiskers.begin, whiskers.end, far.begin) == (0.9, 1.1, 9.0)
    assert (box.begin, box.end) == pytest.approx((0.95, 1.05), abs=0.01)
    (row,) = error_table(rmse[:-1], np.array([np.nan]), ("joint_1",), 0.03, "").rows
    assert len(row[7].bars) == 2


def test_cells_are_shaded_by_the_largest_of_the_same_unit():
    values = np.array([[1.0, np.nan], [0.25, 0.5]])
    table = table_html(shaded_table("cells", "", values, ["slow", "fast"], ["joint_1", "joint_2"], ["%", "N·m"]))
    shades = [int(found, 16) for found in re.findall("background:#d55e00([0-9a-f]{2})", table)]
    assert shades == [140, 0, pytest.approx(76, abs=1), 140]
