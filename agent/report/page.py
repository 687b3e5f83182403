"""One self-contained HTML page: sections of text, tables, plots and a 3-D view, with the data a click away."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from agent.core import csv_text
from agent.report.figures import Figure
from agent.report.plots import Plot, for_screen, packed, plot_csv, spec
from agent.report.scene import Scene, scene_part
from agent.report.stills import still


@dataclass(frozen=True)
class Table:
    """A table: header and rows of text; the first column is the row's name, and leads to `links[row]` where given."""

    name: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    links: Sequence[str] = ()


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, what belongs under them in order, and a listing of program text."""

    title: str
    text: Sequence[str] = ()
    parts: Sequence[Table | Figure | Plot | Scene] = ()
    listing: str = ""


@dataclass(frozen=True)
class NextStep:
    """What to do next, and the command for it, ready to be copied; it may have none."""

    what: str
    command: str = ""


@dataclass(frozen=True)
class About:
    """The first screen beside the answer.

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
    """A report. `verdict` is one of good, bad or plain and colours the headline, which is the answer."""

    title: str
    headline: str
    verdict: str
    sections: Sequence[Section]
    about: About = About()


def render(page: Page) -> str:
    """HTML text: no script or picture from anywhere else, light and dark, printable."""
    from jinja2 import Environment

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(_asset("page.html"))
    sections = [
        {
            "title": section.title,
            "id": identifier,
            "text": section.text,
            "parts": [_part(part) for part in section.parts],
            "listing": section.listing,
        }
        for section, identifier in zip(page.sections, _identifiers(page.sections), strict=True)
    ]
    kinds = {type(part) for section in page.sections for part in section.parts}
    library = _uplot() if Plot in kinds else {}
    scripts = [library["uPlot.iife.js"], _asset("plots.js")] if library else []
    scripts += [_asset("scene.js")] if Scene in kinds else []
    scripts += [_asset("figures.js")] if Figure in kinds else []
    css = library.get("uPlot.min.css", "") + _asset("page.css")
    return template.render(page=page, sections=sections, css=css, scripts=scripts, plots=bool(library))


def _identifiers(sections: Sequence[Section]) -> list[str]:
    """What the address of a section ends with, each its own."""
    found: list[str] = []
    for section in sections:
        name = re.sub(r"[^a-z0-9]+", "-", section.title.lower()).strip("-") or "section"
        found.append(name if name not in found else f"{name}-{len(found)}")
    return found


def _part(part: Table | Figure | Plot | Scene) -> dict[str, Any]:
    if isinstance(part, Table):
        csv = base64.b64encode(csv_text((part.header, *part.rows)).encode()).decode("ascii")
        return {
            "kind": "table",
            "part": part,
            "look": [_look([str(row[k]) for row in part.rows]) for k in range(len(part.header))],
            "csv": f"data:text/csv;base64,{csv}",
        }
    if isinstance(part, Plot):
        shown = for_screen(part)
        return {"kind": "plot", "part": shown, "svg": still(shown), "spec": spec(shown), "csv": packed(plot_csv(shown))}
    if isinstance(part, Figure):
        rows = [[f"{float(value):.6g}" for value in row] for row in part.rows]
        return {"kind": "figure", "part": part, "csv": packed(csv_text((part.header, *rows)))}
    return scene_part(part)


def _uplot() -> dict[str, str]:
    """Script and style of uPlot as text, shortened by what no browser needs; empty where it is not installed.

    The package is found and not imported: it would bring a notebook with it.
    """
    found = find_spec("uplot")
    if found is None or found.origin is None:
        return {}
    folder = Path(found.origin).parent / "static"
    script = (folder / "uPlot.iife.js").read_text(encoding="utf-8")
    lines = (line.strip() for line in script.splitlines())
    kept = "\n".join(line for line in lines if line and not line.startswith("//"))
    return {"uPlot.iife.js": kept, "uPlot.min.css": (folder / "uPlot.min.css").read_text(encoding="utf-8")}


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


def _asset(name: str) -> str:
    return (files("agent.report") / "assets" / name).read_text(encoding="utf-8")
