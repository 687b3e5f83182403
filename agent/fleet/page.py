"""The page over a fleet: one self-contained HTML file with compressed data, drawn on demand.

Machines are sorted by urgency, which puts wear, gaps and failed runs on one scale. Urgency 1 is the gate of a
calibration, an error as a share of nominal torque. A prediction error counts as it is; an alarm of friction counts with
its change of torque, extrapolated by `AHEAD` days.
"""

from __future__ import annotations

import base64
import gzip
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from agent.fleet.machines import FleetMachine
from agent.fleet.store import Store
from agent.fleet.trends import FleetTrends, change_of, change_text, fleet_trends
from agent.pages import asset, filled
from agent.recipe import GateSection
from agent.runs import Trend

#: Normalised RMSE that a calibration is let through with, where its recipe says nothing else.
GATE = float(GateSection.model_fields["normalised_rmse"].default)
#: Time by which a drift is extrapolated [d].
AHEAD = 90.0
#: Relative change of friction that counts as the gate where a joint has no nominal torque.
_LIKE_GATE = 0.2
#: Characters of a reason on the page.
_LONGEST = 300


def write_page(result: str, tables: Sequence[Path] = (), out: str | None = None) -> str:
    """Write the page of a result, into it (`_report.html`) or to the file `out`; returns where it is.

    Args:
        result: address of the folder of results.
        tables: further columns per run.
        out: file of the page; None: in the result.

    Raises:
        InputError: no result, or a table that cannot be used.
        AgentError: the page cannot be written.
    """
    trends = fleet_trends(result, tables)
    folder, name = (result, "_report.html") if out is None else (os.path.dirname(out) or ".", os.path.basename(out))
    store = Store(folder)
    store.put(name, _page(trends, _link_base(trends.source, store)).encode())
    return f"{folder.rstrip('/')}/{name}"


def _page(trends: FleetTrends, base: str) -> str:
    """HTML text; links to the pages of runs begin with `base`."""
    machines = sorted(
        (_machine(trends, machine, base) for machine in trends.machines),
        key=lambda machine: (-machine["urgency"], machine["robot"]),
    )
    data = {
        "kind": trends.kind,
        "joints": list(dict.fromkeys(joint for machine in trends.machines for joint in machine.joints)),
        "gate": GATE,
        "columns": list(trends.tables),
        "machines": machines,
        "families": [{"text": family.text(), "robots": family.robots} for family in trends.families],
    }
    look = sum(bool(machine["why"]) for machine in machines)
    text = json.dumps(data, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return filled(
        "agent.fleet",
        "fleet.html",
        found=trends,
        look=look,
        runs=sum(len(machine.runs) for machine in trends.machines),
        urgent=machines[: min(look, 15)],
        script=asset("agent.fleet", "fleet.js"),
        css=asset("agent.fleet", "fleet.css"),
        data=base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode("ascii"),
    )


def _machine(trends: FleetTrends, machine: FleetMachine, base: str) -> dict[str, Any]:
    weight, reasons = _urgency(machine)
    by_joint = {trend.joint: trend for trend in machine.trends}
    axles = [by_joint.get(joint) for joint in machine.joints]
    return {
        "robot": machine.robot,
        "urgency": round(weight, 3),
        "why": [text[:_LONGEST] for text in reasons],
        "joints": list(machine.joints),
        "gap": [round(1e4 * float(error)) if np.isfinite(error) else None for error in machine.errors],
        "trend": [None if trend is None else round(1e4 * change_of(trend)[0]) for trend in axles],
        "alarm": [int(trend is not None and trend.alarm) for trend in axles],
        "of": [values.get(machine.robot) for values in trends.tables.values()],
        "runs": [
            [run.removeprefix(f"{machine.robot}/"), day, status, reason[:_LONGEST], base + quote(page) if page else ""]
            for run, day, status, reason, page in machine.runs
        ],
        "courses": [_course(trend) for trend in machine.trends],
    }


def _urgency(machine: FleetMachine) -> tuple[float, list[str]]:
    """The urgency of a machine, and the reasons, if any."""
    alarms = [trend for trend in machine.trends if trend.alarm]
    weights, reasons = [0.0, *(_weight(machine, trend) for trend in alarms)], [change_text(trend) for trend in alarms]
    worst = [(error, joint) for error, joint in zip(machine.errors, machine.joints, strict=True) if np.isfinite(error)]
    if worst:
        error, joint = max(worst)
        weights.append(float(error) / GATE if error > GATE or reasons else 0.0)
        if error > GATE:
            reasons.append(f"{joint}: error of {100 * error:.1f} % of nominal torque; {100 * GATE:g} % is the gate")
    if machine.gap:
        reasons.append(machine.gap)
        weights.append(max([0.5, *(float(error) / GATE for error, _ in worst)]))
    if machine.failed:
        reasons.append(f"a run has no figures; {machine.failed}")
        weights.append(1.0)
    return max(weights), reasons


def _weight(machine: FleetMachine, trend: Trend) -> float:
    if trend.quantity != "friction":
        return float(trend.values[-3:].mean()) / GATE
    days = max(float(trend.runs.days[-1] - trend.runs.days[0]), 1.0)
    change = abs(trend.change) * (1 + AHEAD / days if trend.kind == "drift" else 1)
    nominal = machine.nominal[machine.joints.index(trend.joint)]
    if not np.isfinite(nominal):
        return change / _LIKE_GATE
    return change * float(np.median(trend.values)) / (GATE * float(nominal))


def _course(trend: Trend) -> dict[str, Any]:
    """Values in hundredths of a percent over their median."""
    middle, (_, low, high) = float(np.median(trend.values)), change_of(trend)
    return {
        "joint": trend.joint,
        "of": f"{trend.quantity}{trend.at}",
        "text": change_text(trend) if trend.kind != "none" else f"{trend.quantity}{trend.at}: no change",
        "interval": [round(1e4 * low), round(1e4 * high)],
        "level": float(f"{trend.level:.2g}"),
        "days": np.round(trend.runs.days).astype(int).tolist(),
        "values": np.round(1e4 * (trend.values / middle - 1)).astype(int).tolist() if middle else [],
    }


def _link_base(source: str, page: Store) -> str:
    """The link from the page to the source, to be followed by the path of a file."""
    source_folder = Store(source).local if source else None
    if source_folder is None:
        return f"{source}/" if source else ""
    page_folder = page.local
    return (
        f"{quote(os.path.relpath(source_folder, page_folder))}/"
        if page_folder is not None
        else f"{source_folder.absolute().as_uri()}/"
    )
