"""Tables for spreadsheets: a text never becomes a formula there, whoever named the joint, the robot or the page."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence

#: Where a spreadsheet would begin a formula: at the start of a cell, or of what it takes for one.
_FORMULA = re.compile(r"(?:^|(?<=;))(?=\s*[=+\-@＝＋－＠])")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows as CSV, a line each. Numbers stay; a text that would be read as a formula gets an apostrophe before it."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue()


def _cell(value: object) -> str:
    text = _CONTROL.sub(" ", str(value))
    if text == "-" or not _FORMULA.search(text):
        return text
    try:
        float(text)
    except ValueError:
        return _FORMULA.sub("'", text)
    return text
