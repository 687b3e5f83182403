"""One self-contained HTML page: sections of text, tables, plots and a 3-D view, with the data a click away."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import csv_text
from agent.pages.plots import Plot, for_screen, packed, plot_csv, spec
from agent.pages.scene import Scene, scene_part
from agent.pages.stills import still
from agent.pages.templates import asset, filled


@dataclass(frozen=True)
class Shade:
    """A number whose cell is shaded by its size, over the largest of the table with the same unit."""

    value: float
    text: str
    title: str = ""
    unit: str = ""
    colour: str = "#d55e00"


@dataclass(frozen=True)
class Bar:
    """A bar from `begin` to `end`; `top` and `height` are shares of the cell's height."""

    begin: float
    end: float
    colour: str
    top: float = 0.1
    height: float = 0.8


@dataclass(frozen=True)
class Bars:
    """Bars in one cell, and strokes at `marks` by colour; cells of a table with the same unit share a scale."""

    bars: Sequence[Bar]
    marks: Sequence[tuple[float, str]] = ()
    unit: str = ""

    @property
    def places(self) -> list[float]:
        """All finite coordinates along the scale."""
        places = [value for bar in self.bars for value in (bar.begin, bar.end)] + [value for value, _ in self.marks]
        return [value for value in places if math.isfinite(value)]


Cell = str | Shade | Bars


@dataclass(frozen=True)
class Table:
    """A table: header and rows; the first column is the row's name, and leads to `links[row]` where given."""

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    links: Sequence[str] = ()
    caption: str = ""


def shaded_table(
    name: str,
    caption: str,
    values: np.ndarray,
    columns: Sequence[str],
    rows: Sequence[str],
    units: Sequence[str] = (),
    of_row: str = "joint",
) -> Table:
    """Cells (rows, columns) shaded by their values, against the largest of the rows with the same unit."""
    body: list[list[str | Shade]] = [
        [f"{row} [{unit}]" if unit else row, *(Shade(float(value), _figure(value), unit=unit) for value in line)]
        for row, unit, line in zip(rows, units or [""] * len(rows), values, strict=True)
    ]
    return Table(name, (of_row, *(column.replace("_", " ") for column in columns)), body, caption=caption)


def _figure(value: float) -> str:
    return "-" if not math.isfinite(value) else f"{value:.0f}" if value >= 9.95 else f"{value:.2g}"


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, the parts below them in order, and a listing of program text."""

    title: str
    text: Sequence[str] = ()
    parts: Sequence[Table | Plot | Scene] = ()
    listing: str = ""


@dataclass(frozen=True)
class NextStep:
    """The next step, and its command, if there is one."""

    what: str
    command: str = ""


@dataclass(frozen=True)
class About:
    """The first screen in addition to the answer.

    What was `asked`, `facts` that the answer rests on and the `identity` of what the page is about, both as (what,
    value), what comes `next`, and a `picture` (SVG text).
    """

    asked: str = ""
    facts: Sequence[tuple[str, str]] = ()
    next: Sequence[NextStep] = ()
    identity: Sequence[tuple[str, str]] = ()
    picture: str = ""


@dataclass(frozen=True)
class Page:
    """A report. `verdict` is one of good, bad or plain and colours the headline, which is the answer.

    A section that is None has nothing to show and is left out.
    """

    title: str
    headline: str
    verdict: str
    sections: Sequence[Section | None]
    about: About = About()


def render(page: Page) -> str:
    """HTML text: no script or picture from anywhere else, light and dark, printable."""
    shown_sections = [section for section in page.sections if section is not None]
    sections = [
        (name, section, [_part(part) for part in section.parts])
        for name, section in zip(_identifiers(shown_sections), shown_sections, strict=True)
    ]
    kinds = {type(part) for section in shown_sections for part in section.parts}
    library = _uplot() if Plot in kinds else {}
    scripts = [library["uPlot.iife.js"], asset("agent.pages", "plots.js")] if library else []
    scripts += [asset("agent.pages", "scene.js")] if Scene in kinds else []
    css = library.get("uPlot.min.css", "") + asset("agent.pages", "page.css")
    values = {"page": page, "sections": sections, "css": css, "scripts": scripts, "plots": bool(library)}
    return filled("agent.pages", "page.html", **values)


def _identifiers(sections: Sequence[Section]) -> list[str]:
    """Unique fragment of the address of a section."""
    identifiers: list[str] = []
    for section in sections:
        name = re.sub(r"[^a-z0-9]+", "-", section.title.lower()).strip("-") or "section"
        identifiers.append(name if name not in identifiers else f"{name}-{len(identifiers)}")
    return identifiers


def _part(part: Table | Plot | Scene) -> dict[str, Any]:
    if isinstance(part, Table):
        columns = [k for k in range(len(part.header)) if not any(isinstance(row[k], Bars) for row in part.rows)]
        rows = [[_text(row[k]) for k in columns] for row in (part.header, *part.rows)]
        csv = base64.b64encode(csv_text(rows).encode()).decode("ascii")
        return {"kind": "table", "part": part, "html": table_html(part), "csv": f"data:text/csv;base64,{csv}"}
    if isinstance(part, Plot):
        on_screen = for_screen(part)
        return {
            "kind": "plot",
            "part": on_screen,
            "svg": still(on_screen),
            "spec": spec(on_screen),
            "csv": packed(plot_csv(on_screen)),
        }
    return scene_part(part)


def table_html(table: Table) -> str:
    """The element `table`: pictures in its cells need no style sheet."""
    looks = [_look([_text(row[k]) for row in table.rows]) for k in range(len(table.header))]
    scales = _scales(table)

    def at(cell: Bars, value: float) -> float:
        low, high = scales[Bars, cell.unit]
        return 200.0 * (value - low) / (high - low)

    def opacity(cell: Shade) -> str:
        _, high = scales[Shade, cell.unit]
        share = round(100 * (0.05 + 0.5 * abs(cell.value) / high)) if math.isfinite(cell.value) else 0
        return f"{round(2.55 * share):02x}"

    drawing = {"at": at, "opacity": opacity, "finite": math.isfinite}
    return filled("agent.pages", "table.html", table=table, looks=looks, **drawing)


def _scales(table: Table) -> dict[tuple[type, str], tuple[float, float]]:
    """Least and largest value of the shades and bars of each unit, 0 among them."""
    columns: dict[tuple[type, str], list[float]] = {}
    for cell in (cell for row in table.rows for cell in row if not isinstance(cell, str)):
        places = cell.places if isinstance(cell, Bars) else [abs(cell.value)]
        columns.setdefault((type(cell), cell.unit), [0.0]).extend(filter(math.isfinite, places))
    return {key: (min(places), max(places) if max(places) > min(places) else 1.0) for key, places in columns.items()}


def _text(cell: Cell) -> str:
    return cell if isinstance(cell, str) else cell.text if isinstance(cell, Shade) else ""


def _uplot() -> dict[str, str]:
    """Script and style of uPlot as text, shortened by what no browser needs; empty where it is not installed.

    The package is found and not imported: it would bring a notebook with it.
    """
    spec = find_spec("uplot")
    if spec is None or spec.origin is None:
        return {}
    folder = Path(spec.origin).parent / "static"
    script = (folder / "uPlot.iife.js").read_text(encoding="utf-8")
    lines = (line.strip() for line in script.splitlines())
    code = "\n".join(line for line in lines if line and not line.startswith("//"))
    return {"uPlot.iife.js": code, "uPlot.min.css": (folder / "uPlot.min.css").read_text(encoding="utf-8")}


def _look(cells: Sequence[str]) -> str:
    """Class of a column: numbers stand to the right, text to the left, and long text is broken into lines."""
    words = [cell for cell in cells if cell not in ("", "-") and not _is_number(cell)]
    return "" if not words else "text long" if max(map(len, words)) > 24 else "text"


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
