"""The page over all runs of a folder: what the gate said, what drifts, and every run with its report."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from agent.core import counted
from agent.report.history_plots import error_plot, machine_plot
from agent.report.page import About, NextStep, Page, Section, Table, render
from agent.report.plots import Plot

if TYPE_CHECKING:
    from agent.runs import PastRun, Trend, Watch


@dataclass(frozen=True, eq=False)
class IndexData:
    """All runs, oldest first; what the trends say per machine and program, and the course of its parameters.

    `current` names the runs that the robots' current models are of.
    """

    runs: Sequence[PastRun]
    watched: Sequence[Watch]
    parameters: Sequence[Sequence[Trend]]
    current: Collection[str] = ()


def index_page(data: IndexData) -> str:
    """HTML text; links lead to reports in the folders beside the page."""
    alarms = [(one, line) for one in data.watched for line in one.lines()]
    machines = sorted({(run.robot, run.serial) for run in data.runs})
    names = ", ".join(f"{robot} {serial}".strip() for robot, serial in machines)
    if alarms:
        headline, verdict = " · ".join(line for _, line in alarms[:4]), "bad"
    elif data.watched:
        headline, verdict = "No friction drifts, and no limit is near.", "good"
    else:
        headline, verdict = (
            f"{counted(len(data.runs), 'run')}; trends need at least eight runs of one program.",
            "plain",
        )
    sections = [
        _machine(one, parameters, number, data)
        for number, (one, parameters) in enumerate(zip(data.watched, data.parameters, strict=True))
    ]
    errors = [error_plot(data.runs, data.current, *machine, number) for number, machine in enumerate(machines)]
    if plots := [plot for plot in errors if plot is not None]:
        sections.append(Section("Prediction error", (), plots))
    sections.append(_all_runs(data))
    return render(Page(f"Calibrations of {names}", headline, verdict, sections, _about(data, alarms)))


def _about(data: IndexData, alarms: Sequence[tuple[Watch, str]]) -> About:
    newest = data.runs[-1]
    steps = []
    if alarms:
        one = alarms[0][0]
        name = shlex.quote(one.robot)
        serial = f" --serial {shlex.quote(one.serial)}" if one.serial else ""
        steps.append(NextStep("all figures of that machine", f"agent history --robot {name}{serial} --json"))
    models = ", ".join(sorted(data.current)) or "none"
    identity = [
        ("runs", f"{len(data.runs)}, {sum(run.accepted for run in data.runs)} accepted"),
        ("newest", f"{newest.started[:16].replace('T', ' ')} UTC"),
        ("current models", models),
    ]
    return About("How are the machines and their models doing?", (), steps, identity)


def _all_runs(data: IndexData) -> Section:
    runs = data.runs
    rows = [
        (
            run.run,
            run.outcome_with(data.current),
            run.worst_text,
            run.kind,
            run.serial or "-",
            str(run.data["conditions"].get("cycles", "-")),
            run.reason,
        )
        for run in reversed(runs)
    ]
    links = [f"{quote(run.run)}/report.html" if run.complete else "" for run in reversed(runs)]
    accepted = sum(run.accepted for run in runs)
    text = (f"{counted(len(runs), 'run')}, {accepted} accepted; the newest first.",)
    header = ("run", "result", "worst axis", "kind", "serial", "cycles", "cause or reason")
    return Section("Runs", text, (Table("runs", header, rows, links),))


def _machine(one: Watch, parameters: Sequence[Trend], number: int, data: IndexData) -> Section:
    name = f"{one.robot} {one.serial}".strip()
    text = one.lines() or ["No drift or step is both significant and of practical size."]
    rows = [
        (
            trend.name,
            trend.kind,
            f"{100 * trend.change:+.2f}" if trend.kind != "none" else "",
            trend.since,
            f"{trend.probability:.1g}",
            f"{100 * (np.ptp(trend.common)):.2f}",
            "alarm" if trend.alarm else "",
        )
        for trend in sorted(one.trends, key=lambda trend: (not trend.alarm, trend.probability))
    ]
    header = ("friction", "course", "change [%]", "after run", "by chance", "warm-up explains [%]", "")
    explained = (
        "All axles share the warm-up. The other axles, and the change of friction within a run, separate it from wear. "
        "By chance: probability that scatter alone causes as much. Alarms use the friction at a speed, as single "
        "parameters are correlated."
    )
    parts: list[Plot | Table] = [machine_plot(one, parameters, number, data.runs, data.current)]
    parts.append(Table(f"friction-trends-{number}", header, rows))
    if parameters:
        parts.append(_parameter_table(parameters, number))
    return Section(f"{name}: history of one program", [*text, explained], parts)


def _parameter_table(parameters: Sequence[Trend], number: int) -> Table:
    rows = [
        (
            trend.name,
            trend.unit,
            f"{trend.values[-1]:.5g}",
            f"{trend.deviations[-1]:.2g}",
            trend.kind,
            f"{trend.expected[-1] - trend.expected[0]:+.3g}" if trend.kind != "none" else "",
            trend.since,
        )
        for trend in parameters
    ]
    header = ("parameter", "unit", "latest", "std. dev.", "course", "change", "after run")
    return Table(f"parameters-{number}", header, rows)
