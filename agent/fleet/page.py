"""The page over a fleet: one self-contained HTML file, its data compressed once and drawn where they are looked at."""

from __future__ import annotations

import base64
import gzip
import json
import os
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from agent.fleet.look import GATE, MachineSummary, see, urgency
from agent.fleet.store import Store
from agent.fleet.trends import Course, FleetTrends, fleet_trends, source_of

#: Characters of a reason on the page.
_LONGEST = 300


def write_page(result: str, tables: Sequence[Path] = (), out: str | None = None) -> str:
    """Write the page of a result, into it (`_report.html`) or to the file `out`; returns where it is.

    Raises:
        InputError: no result, or a table that cannot be used.
        AgentError: the page cannot be written.
    """
    summaries: list[MachineSummary] = []
    courses: list[list[Course]] = []

    def keep(machine: Any, found: list[Course]) -> None:
        summaries.append(see(machine))
        courses.append(found)

    found = fleet_trends(result, tables, keep)
    folder, name = (result, "_report.html") if out is None else (os.path.dirname(out) or ".", os.path.basename(out))
    store = Store(folder)
    source = source_of(result)
    page = fleet_page(found, summaries, courses, _link_base(source, store))
    store.put(name, page.encode())
    return f"{folder.rstrip('/')}/{name}"


def fleet_page(
    found: FleetTrends, summaries: Sequence[MachineSummary], courses: Sequence[Sequence[Course]], base: str
) -> str:
    """HTML text; links to the pages of runs begin with `base`."""
    from jinja2 import Environment

    machines = [
        _machine(found, summary, own, base) | {"courses": [_course(one, summary) for one in own]}
        for summary, own in zip(summaries, courses, strict=True)
    ]
    machines.sort(key=lambda one: (-one["urgency"], one["robot"]))
    joints = list(dict.fromkeys(joint for summary in summaries for joint in summary.joints))
    data = {
        "kind": found.kind,
        "joints": joints,
        "gate": GATE,
        "columns": list(found.tables),
        "machines": machines,
        "families": [{"text": one.text(), "robots": one.robots} for one in found.families],
    }
    look = sum(bool(one["why"]) for one in machines)
    text = json.dumps(data, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    packed = base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode("ascii")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(_asset("fleet.html")).render(
        found=found,
        look=look,
        runs=sum(len(summary.runs) for summary in summaries),
        urgent=machines[: min(look, 15)],
        script=_asset("fleet.js"),
        css=_asset("fleet.css"),
        data=packed,
    )


def _machine(found: FleetTrends, summary: MachineSummary, own: Sequence[Course], base: str) -> dict[str, Any]:
    weight, reasons = urgency(summary, own)
    trend = {one.joint: one for one in own}
    return {
        "robot": summary.robot,
        "urgency": round(weight, 3),
        "why": [text[:_LONGEST] for text in reasons],
        "joints": list(summary.joints),
        "gap": [round(1e4 * float(error)) if np.isfinite(error) else None for error in summary.errors],
        "trend": [round(1e4 * trend[j].change) if j in trend else None for j in summary.joints],
        "alarm": [int(trend[j].alarm) if j in trend else 0 for j in summary.joints],
        "of": [values.get(summary.robot) for values in found.tables.values()],
        "runs": [
            [run.removeprefix(f"{summary.robot}/"), day, status, reason[:_LONGEST], base + quote(page) if page else ""]
            for run, day, status, reason, page in summary.runs
        ],
    }


def _course(one: Course, summary: MachineSummary) -> dict[str, Any]:
    """Values in hundredths of a percent over their median."""
    middle = float(np.median(one.values))
    return {
        "joint": one.joint,
        "of": one.quantity,
        "text": one.text() if one.kind != "none" else f"{one.quantity}: no change",
        "interval": [round(1e4 * one.low), round(1e4 * one.high)],
        "level": float(f"{one.level:.2g}"),
        "days": np.round(one.days).astype(int).tolist(),
        "values": np.round(1e4 * (one.values / middle - 1)).astype(int).tolist() if middle else [],
    }


def _link_base(source: str, page: Store) -> str:
    """What leads from the page to a file of the source."""
    there = Store(source).local if source else None
    if there is None:
        return f"{source}/" if source else ""
    here = page.local
    return f"{quote(os.path.relpath(there, here))}/" if here is not None else f"{there.absolute().as_uri()}/"


def _asset(name: str) -> str:
    return (files("agent.fleet") / "assets" / name).read_text(encoding="utf-8")
