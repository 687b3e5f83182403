"""A plot as data: what a page draws interactively, prints as a still picture, and gives away as a table."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np

from agent.core import csv_text
from agent.robot import RobotDescription

#: Seven colours that read on white and on near-black, and that the colour-blind distinguish (after Okabe and Ito).
SERIES = ("#2a86c8", "#d55e00", "#009e73", "#c0649a", "#8f75d6", "#9a7d0a", "#3f9fb5")
#: A pattern of strokes and gaps [px] for each of them, so that lines differ without colour; the first is solid.
DASHES = ((), (8, 3), (2, 3), (8, 3, 2, 3), (14, 4), (5, 5), (8, 3, 2, 3, 2, 3))
#: Rows of a plot, at most: more than a wide screen has pixels for.
MOST_ROWS = 2400
_DASHED = (6, 4)  # of a curve that looks dashed
#: Link of a plot whose panels zoom alone.
UNLINKED = "-"


@dataclass(frozen=True, eq=False)
class Series:
    """One curve: `values` (S,) over the panel's abscissa, NaN where there is nothing.

    `look` is line, dashed, points, or part (of a stack, positive and negative parts apart); with `low` (S,) it is the
    band between `low` and `values`. `joint` lets a reader switch it on and off with its joint; `dash`: strokes and gaps
    of its line [px].
    """

    label: str
    values: np.ndarray
    look: str = "line"
    colour: str = SERIES[0]
    low: np.ndarray | None = None
    joint: str = ""
    dash: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves that share two axes. `x` (S,) ascending, where it is not the plot's; `marks` are dotted levels by name;
    `from_zero`: the ordinate begins there."""

    title: str
    unit: str
    series: Sequence[Series]
    x: np.ndarray | None = None
    marks: dict[str, float] = field(default_factory=dict)
    from_zero: bool = False
    joint: str = ""


@dataclass(frozen=True, eq=False)
class Plot:
    """Panels under one caption. `x` (S,) ascending, in `x_unit`; `dates`: `x` is seconds since 1970, UTC.

    Plots of one `link` zoom together, or panels of one plot if it has none. `columns`: panels in a row if the page is
    wide enough.
    """

    name: str
    caption: str
    x_label: str
    panels: Sequence[Panel]
    x: np.ndarray | None = None
    x_unit: str = ""
    link: str = ""
    dates: bool = False
    columns: int = 1

    @property
    def abscissa_name(self) -> str:
        """With its unit."""
        return f"{self.x_label} [{self.x_unit}]" if self.x_unit else self.x_label

    def abscissa(self, panel: Panel) -> np.ndarray:
        """(S,) of a panel."""
        x = self.x if panel.x is None else panel.x
        assert x is not None
        return x


def joint_series(joints: Sequence[str], values: np.ndarray, order: Sequence[int] | None = None) -> list[Series]:
    """A curve a joint of (S, n), each with its colour and dashes; in the `order` of their numbers where given.

    Args:
        joints: names.
        values: (S, n).
        order: of the joints; None: as they are.
    """
    chosen = range(len(joints)) if order is None else order
    looks = [(SERIES[k % len(SERIES)], DASHES[k % len(DASHES)]) for k in range(len(joints))]
    return [Series(joints[k], values[:, k], colour=looks[k][0], joint=joints[k], dash=looks[k][1]) for k in chosen]


def worst_first(robot: RobotDescription, error: np.ndarray) -> list[int]:
    """Joints by their error (n,) over nominal torque, the largest first; by the error itself where one has none."""
    nominal = robot.nominal_torque
    size = error / nominal if np.isfinite(nominal).all() else error
    return [int(k) for k in np.argsort(-size, kind="stable")]


def thinned(columns: np.ndarray, most: int = MOST_ROWS) -> np.ndarray:
    """Indices of rows that show (S, k) columns: evenly spaced ones, and the extremes of every column in each stretch.

    All rows where they are no more than `most`; otherwise about as many, ascending, ends included.
    """
    size, count = columns.shape
    if size <= most:
        return np.arange(size)
    stretches = max(1, most // (4 * count))
    edges = np.linspace(0, size, stretches + 1).astype(int)
    indices = set(np.linspace(0, size - 1, most // 2).astype(int).tolist())
    for start, stop in pairwise(edges):
        part = columns[start:stop]
        safe = np.where(np.isfinite(part), part, 0.0)
        indices.update((start + safe.argmin(axis=0)).tolist(), (start + safe.argmax(axis=0)).tolist())
    return np.array(sorted(indices))


def for_screen(plot: Plot) -> Plot:
    """The same plot with no more rows than a screen can show: panels of one abscissa are thinned alike."""
    if plot.x is None:
        return replace(plot, panels=[_part(panel, _kept([panel])) for panel in plot.panels])
    shared = [panel for panel in plot.panels if panel.x is None]
    indices = _kept(shared)
    panels = [_part(panel, indices if panel.x is None else _kept([panel])) for panel in plot.panels]
    return replace(plot, x=plot.x[indices], panels=panels)


def _kept(panels: Sequence[Panel]) -> np.ndarray:
    columns = [values for panel in panels for series in panel.series for values in (series.values, series.low)]
    return thinned(np.column_stack([values for values in columns if values is not None]))


def _part(panel: Panel, rows: np.ndarray) -> Panel:
    series = [
        replace(curve, values=curve.values[rows], low=None if curve.low is None else curve.low[rows])
        for curve in panel.series
    ]
    return replace(panel, series=series, x=None if panel.x is None else panel.x[rows])


def table(plot: Plot) -> tuple[list[str], list[np.ndarray]]:
    """Names and values of the columns behind a plot; those of panels with an abscissa of their own may be shorter."""
    header, columns = [], []
    if plot.x is not None:
        header.append(plot.abscissa_name)
        columns.append(plot.x)
    several = len(plot.panels) > 1
    for panel in plot.panels:
        before = f"{panel.title} " if several and panel.title else ""
        if panel.x is not None:
            header.append(before + plot.abscissa_name)
            columns.append(panel.x)
        for series in panel.series:
            ends = {"": series.values} if series.low is None else {" from": series.low, " to": series.values}
            for end, values in ends.items():
                header.append(f"{before}{series.label}{end}" + (f" [{panel.unit}]" if panel.unit else ""))
                columns.append(np.asarray(values, dtype=float))
    return header, columns


def plot_csv(plot: Plot) -> str:
    """The same as text, six digits; cells are empty where there is nothing."""
    header, columns = table(plot)
    dates = [plot.dates and name.endswith(plot.abscissa_name) for name in header]
    texts = [_cells(values, date) for values, date in zip(columns, dates, strict=True)]
    longest = max(map(len, texts))
    padded = [cells + [""] * (longest - len(cells)) for cells in texts]
    return csv_text([header, *zip(*padded, strict=True)])


def packed(text: str) -> str:
    """Text as a link that downloads it, compressed; the same text gives the same link."""
    data = gzip.compress(text.encode("utf-8"), 9, mtime=0)
    return "data:application/gzip;base64," + base64.b64encode(data).decode("ascii")


def spec(plot: Plot) -> str:
    """Settings for the page's script in addition to the data: JSON, safe inside a script element."""
    panels = [
        {
            "title": panel.title,
            "unit": panel.unit,
            "joint": panel.joint,
            "own": panel.x is not None,
            "zero": panel.from_zero,
            "marks": list(panel.marks.items()),
            "series": [
                {
                    "label": series.label,
                    "look": series.look if series.low is None else "band",
                    "colour": series.colour,
                    "joint": series.joint,
                    "dash": _DASHED if series.look == "dashed" else series.dash,
                }
                for series in panel.series
            ],
        }
        for panel in plot.panels
    ]
    axis = {
        "shared": plot.x is not None,
        "label": plot.x_label,
        "unit": plot.x_unit,
        "dates": plot.dates,
        "link": plot.link or plot.name,
    }
    return json.dumps({**axis, "panels": panels}, ensure_ascii=False).replace("<", "\\u003c")


def _cells(values: np.ndarray, date: bool) -> list[str]:
    if date:
        return [datetime.fromtimestamp(value, UTC).strftime("%Y-%m-%dT%H:%M:%SZ") for value in values.tolist()]
    return [f"{value:.6g}" if np.isfinite(value) else "" for value in values.tolist()]
