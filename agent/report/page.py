"""One self-contained HTML page: sections of text, tables, plots and a 3-D view, with the data a click away."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from agent.report.figures import Figure


@dataclass(frozen=True)
class Table:
    """A table: header and rows of text; the first column is the row's name, and leads to `links[row]` where given."""

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    links: Sequence[str] = ()


@dataclass(frozen=True)
class Scene:
    """A 3-D view that turns: named polylines (k, 3) and points (k, 3) in metres, and boxes (min, max)."""

    name: str
    caption: str
    lines: dict[str, np.ndarray] = field(default_factory=dict)
    points: dict[str, np.ndarray] = field(default_factory=dict)
    boxes: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, what belongs under them in order, and a listing of program text."""

    title: str
    text: Sequence[str] = ()
    parts: Sequence[Table | Figure | Scene] = ()
    listing: str = ""


@dataclass(frozen=True)
class Page:
    """A report. `verdict` is one of good, bad or plain and colours the headline."""

    title: str
    headline: str
    verdict: str
    sections: Sequence[Section]


def render(page: Page) -> str:
    """HTML text: no script or picture from anywhere else, light and dark, printable."""
    from jinja2 import Environment

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(_asset("page.html"))
    sections = [
        {
            "title": section.title,
            "text": section.text,
            "parts": [_part(part) for part in section.parts],
            "listing": section.listing,
        }
        for section in page.sections
    ]
    scenes = any(isinstance(part, Scene) for section in page.sections for part in section.parts)
    return template.render(
        page=page, sections=sections, css=_asset("page.css"), script=_asset("scene.js") if scenes else ""
    )


def _part(part: Table | Figure | Scene) -> dict[str, Any]:
    if isinstance(part, Table):
        return {
            "kind": "table",
            "part": part,
            "look": [_look([str(row[k]) for row in part.rows]) for k in range(len(part.header))],
            "csv": _data_link(_csv(part.header, part.rows)),
        }
    if isinstance(part, Figure):
        rows = [[repr(float(value)) for value in row] for row in part.rows]
        return {"kind": "figure", "part": part, "csv": _data_link(_csv(part.header, rows))}
    data = {
        "lines": {name: np.round(line, 5).tolist() for name, line in part.lines.items()},
        "points": {name: np.round(points, 5).tolist() for name, points in part.points.items()},
        "boxes": {
            name: [np.asarray(low).tolist(), np.asarray(high).tolist()] for name, (low, high) in part.boxes.items()
        },
    }
    rows = [[name, *map(repr, point)] for name, line in {**data["lines"], **data["points"]}.items() for point in line]
    text = json.dumps(data).replace("<", "\\u003c")
    return {"kind": "scene", "part": part, "json": text, "csv": _data_link(_csv(("what", "x_m", "y_m", "z_m"), rows))}


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


def _csv(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def cell(value: object) -> str:
        text = str(value)
        return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text

    return "\n".join(",".join(cell(value) for value in row) for row in (header, *rows)) + "\n"


def _data_link(text: str) -> str:
    return "data:text/csv;base64," + base64.b64encode(text.encode("utf-8")).decode("ascii")


def _asset(name: str) -> str:
    return (files("agent.report") / "assets" / name).read_text(encoding="utf-8")
