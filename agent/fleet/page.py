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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from agent.fleet.machines import MachineRuns
from agent.fleet.store import Store
from agent.fleet.trends import AxleTrend, FleetTrends, fleet_trends, source_of
from agent.recipe import GateSection

#: Normalised RMSE that a calibration is let through with, where its recipe says nothing else.
GATE = float(GateSection.model_fields["normalised_rmse"].default)
#: Time by which a drift is extrapolated [d].
AHEAD = 90.0
#: Relative change of friction that counts as the gate where a joint has no nominal torque.
_LIKE_GATE = 0.2
_VERDICTS = {
    "explained": "the gap between model and robot is explained",
    "ambiguous": "there is a gap between model and robot that several causes explain equally well",
    "unknown": "there is a gap between model and robot that no known effect explains",
}
#: Characters of a reason on the page.
_LONGEST = 300


@dataclass(frozen=True, eq=False)
class MachineSummary:
    """A machine as the page shows it.

    `errors` (n,) are the latest, NaN where unknown; `runs` have name, day, status, reason and page. `failed`: why its
    latest run, or one without a date, has no figures; `gap`: what its latest diagnosis says, where there is one.
    """

    robot: str
    joints: tuple[str, ...]
    nominal: np.ndarray
    errors: np.ndarray
    runs: list[tuple[str, str, str, str, str | None]]
    failed: str
    gap: str
    axles: list[AxleTrend]

    @classmethod
    def of(cls, machine: MachineRuns, axles: list[AxleTrend]) -> MachineSummary:
        """The summary of a machine."""
        runs = [
            (row["run"], machine.date(k), row["status"], row["reason"], row["page"])
            for k, row in enumerate(machine.rows)
        ]
        latest = max(machine.with_figures, default=-1)
        failed = [
            f"{status}: {reason}"
            for row, (_, date, status, reason, _) in enumerate(runs)
            if status != "ok" and (not date or row > latest)
        ]
        n, (_, errors) = len(machine.joints), machine.errors
        known = len(errors) > 0 and errors.shape[1] == n
        return cls(
            machine.robot,
            machine.joints,
            machine.nominal,
            errors[-1] if known else np.full(n, np.nan),
            runs,
            failed[-1] if failed else "",
            _gap(machine.rows[-1]),
            axles,
        )

    def urgency(self) -> tuple[float, list[str]]:
        """The urgency of the machine, and the reasons, if any."""
        alarms = [one for one in self.axles if one.trend.alarm]
        weights, reasons = [0.0, *map(self._weight, alarms)], [one.text() for one in alarms]
        worst = [(error, joint) for error, joint in zip(self.errors, self.joints, strict=True) if np.isfinite(error)]
        if worst:
            error, joint = max(worst)
            weights.append(float(error) / GATE if error > GATE or reasons else 0.0)
            if error > GATE:
                reasons.append(f"{joint}: error of {100 * error:.1f} % of nominal torque; {100 * GATE:g} % is the gate")
        if self.gap:
            reasons.append(self.gap)
            weights.append(max([0.5, *(float(error) / GATE for error, _ in worst)]))
        if self.failed:
            reasons.append(f"a run has no figures; {self.failed}")
            weights.append(1.0)
        return max(weights), reasons

    def _weight(self, one: AxleTrend) -> float:
        trend = one.trend
        if trend.quantity != "friction":
            return float(trend.values[-3:].mean()) / GATE
        days = max(float(trend.times[-1] - trend.times[0]), 1.0)
        going_on = one.change * AHEAD / days if trend.kind == "drift" else 0.0
        change = abs(one.change) + abs(going_on)
        nominal = self.nominal[self.joints.index(trend.joint)]
        if not np.isfinite(nominal):
            return change / _LIKE_GATE
        return change * float(np.median(trend.values)) / (GATE * float(nominal))


def write_page(result: str, tables: Sequence[Path] = (), out: str | None = None) -> str:
    """Write the page of a result, into it (`_report.html`) or to the file `out`; returns where it is.

    Raises:
        InputError: no result, or a table that cannot be used.
        AgentError: the page cannot be written.
    """
    machines: list[MachineSummary] = []
    found = fleet_trends(result, tables, lambda machine, axles: machines.append(MachineSummary.of(machine, axles)))
    folder, name = (result, "_report.html") if out is None else (os.path.dirname(out) or ".", os.path.basename(out))
    store = Store(folder)
    page = fleet_page(found, machines, _link_base(source_of(result), store))
    store.put(name, page.encode())
    return f"{folder.rstrip('/')}/{name}"


def fleet_page(found: FleetTrends, summaries: Sequence[MachineSummary], base: str) -> str:
    """HTML text; links to the pages of runs begin with `base`."""
    from jinja2 import Environment

    machines = sorted(
        (_machine(found, one, base) for one in summaries), key=lambda one: (-one["urgency"], one["robot"])
    )
    data = {
        "kind": found.kind,
        "joints": list(dict.fromkeys(joint for one in summaries for joint in one.joints)),
        "gate": GATE,
        "columns": list(found.tables),
        "machines": machines,
        "families": [{"text": one.text(), "robots": one.robots} for one in found.families],
    }
    look = sum(bool(one["why"]) for one in machines)
    text = json.dumps(data, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(_asset("fleet.html")).render(
        found=found,
        look=look,
        runs=sum(len(one.runs) for one in summaries),
        urgent=machines[: min(look, 15)],
        script=_asset("fleet.js"),
        css=_asset("fleet.css"),
        data=base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode("ascii"),
    )


def _machine(found: FleetTrends, summary: MachineSummary, base: str) -> dict[str, Any]:
    weight, reasons = summary.urgency()
    by_joint = {one.trend.joint: one for one in summary.axles}
    axles = [by_joint.get(joint) for joint in summary.joints]
    return {
        "robot": summary.robot,
        "urgency": round(weight, 3),
        "why": [text[:_LONGEST] for text in reasons],
        "joints": list(summary.joints),
        "gap": [round(1e4 * float(error)) if np.isfinite(error) else None for error in summary.errors],
        "trend": [None if one is None else round(1e4 * one.change) for one in axles],
        "alarm": [int(one is not None and one.trend.alarm) for one in axles],
        "of": [values.get(summary.robot) for values in found.tables.values()],
        "runs": [
            [run.removeprefix(f"{summary.robot}/"), day, status, reason[:_LONGEST], base + quote(page) if page else ""]
            for run, day, status, reason, page in summary.runs
        ],
        "courses": [_course(one) for one in summary.axles],
    }


def _course(one: AxleTrend) -> dict[str, Any]:
    """Values in hundredths of a percent over their median."""
    trend = one.trend
    middle = float(np.median(trend.values))
    return {
        "joint": trend.joint,
        "of": one.quantity,
        "text": one.text() if trend.kind != "none" else f"{one.quantity}: no change",
        "interval": [round(1e4 * one.low), round(1e4 * one.high)],
        "level": float(f"{one.level:.2g}"),
        "days": np.round(trend.times).astype(int).tolist(),
        "values": np.round(1e4 * (trend.values / middle - 1)).astype(int).tolist() if middle else [],
    }


def _gap(told: Mapping[str, Any]) -> str:
    """What the latest run says about the gap; empty where there is none, or the run is no diagnosis."""
    verdict = _VERDICTS.get(told.get("verdict") or "", "")
    causes = told.get("causes") or ()
    named = "; ".join(f"{cause['effect']} on {', '.join(cause['joints']) or 'the whole arm'}" for cause in causes)
    return f"{verdict}: {named}" if verdict and named else verdict


def _link_base(source: str, page: Store) -> str:
    """The link from the page to the source, to be followed by the path of a file."""
    there = Store(source).local if source else None
    if there is None:
        return f"{source}/" if source else ""
    here = page.local
    return f"{quote(os.path.relpath(there, here))}/" if here is not None else f"{there.absolute().as_uri()}/"


def _asset(name: str) -> str:
    return (files("agent.fleet") / "assets" / name).read_text(encoding="utf-8")
