"""How figures are written for people, and tables for spreadsheets; nothing heavy, so that listing runs is quick."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence


def error_text(share: float | None, torque: float | None, unit: str = "N·m", digits: int = 2) -> str:
    """`share` of nominal torque in percent; where it is None or NaN the torque itself; "-" without either.

    Args:
        share: of nominal torque.
        torque: in `unit`.
        unit: of the torque.
        digits: that are significant.
    """
    if share is not None and math.isfinite(share):
        return f"{100 * share:.{digits}f} %"
    if torque is not None and math.isfinite(torque):
        return f"{torque:.3g} {unit}"
    return "-"


def counted(number: int, noun: str) -> str:
    """A count with its noun, as "1 log" or "3 logs"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def and_list(names: Sequence[str]) -> str:
    """Names for a sentence: "a", "a and b", "a, b and c"; empty without any."""
    return " and ".join(part for part in (", ".join(names[:-1]), *names[-1:]) if part)


def comma_list(names: Sequence[str], most: int) -> str:
    """Names for a message, with … for those after the first `most`."""
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")


def plus_minus(value: float, half: float) -> str:
    """A value with half of its interval, to two digits of the latter: "4.003 ± 0.021"; four digits without one."""
    if not math.isfinite(half) or half <= 0:
        return f"{value:.4g}" if not 1e4 <= abs(value) < 1e6 else f"{float(f'{value:.4g}'):.0f}"
    size = max(abs(value), half)
    if size >= 1e6 or size < 1e-3:
        power = math.floor(math.log10(size))
        return f"({plus_minus(value / 10**power, half / 10**power)})e{power}"
    places = 1 - math.floor(math.log10(half))
    decimals = max(0, places)
    return f"{round(value, places) + 0.0:.{decimals}f} ± {round(half, places):.{decimals}f}"


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
