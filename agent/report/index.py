"""The page over all runs of a folder: what the gate said, what drifts, and every run with its report."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from agent.report.figures import SERIES, Figure, new_plot, to_figure
from agent.report.page import Page, Section, Table, render

if TYPE_CHECKING:
    from agent.runs.past_run import PastRun
    from agent.runs.trends import Trend, Watch

_MOST_POINTS = 400


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
        headline, verdict = "No axle's friction drifts, and no limit comes near.", "good"
    else:
        headline, verdict = f"{len(data.runs)} runs; trends need at least eight runs of one program.", "plain"
    sections = [_all_runs(data)]
    sections += [
        section
        for number, (one, parameters) in enumerate(zip(data.watched, data.parameters, strict=True))
        for section in _machine(one, parameters, number)
    ]
    sections.append(_errors(data.runs))
    return render(Page(f"Calibrations of {names}", headline, verdict, sections))


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
    text = (f"{len(runs)} runs, {accepted} accepted; the newest first.",)
    header = ("run", "result", "worst axis", "kind", "serial", "cycles", "reason")
    return Section("Runs", text, (Table("runs", header, rows, links),))


def _machine(one: Watch, parameters: Sequence[Trend], number: int) -> list[Section]:
    name = f"{one.robot} {one.serial}".strip()
    text = one.lines() or ["No drift and no step that is both no chance and of practical size."]
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
        for trend in one.trends
    ]
    header = ("friction", "course", "change [%]", "after run", "by chance", "warm-up explains [%]", "")
    explained = (
        "Warm-up, which all axles share, is told from wear by the other axles and by how fast friction changed within "
        "a run. By chance: probability that scatter alone does as much."
    )
    title = f"{name}: friction over the latest {len(one.trends[0].runs) if one.trends else 0} runs"
    parts = (_friction_figure(one, number), Table(f"friction-trends-{number}", header, rows))
    course = Section(title, [*text, explained], parts)
    if not parameters:
        return [course]
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
    figure = _parameter_figure(parameters, number)
    single = ("Single friction parameters lean on each other; alarms go by friction at a speed, above.",)
    return [course, Section(f"{name}: parameters", single, (figure, Table(f"parameters-{number}", header, rows)))]


def _friction_figure(one: Watch, number: int) -> Figure:
    plot, axes = new_plot(height=3.4)
    axis = axes[0, 0]
    fastest = {trend.joint: trend for trend in one.trends}  # the last one of a joint is at its higher speed
    for colour, trend in zip(_colours(len(fastest)), fastest.values(), strict=True):
        start = np.median(trend.values[:3])
        axis.plot(trend.times, 100 * (trend.values / start - 1), ".", color=colour, label=trend.joint, markersize=4)
        axis.plot(trend.times, 100 * (trend.expected / start - 1), color=colour, linewidth=2 if trend.alarm else 0.8)
    axis.set_xlabel("days since the first of these runs")
    axis.set_ylabel("change of friction [%]")
    axis.legend(ncols=4, fontsize=7)
    first = next(iter(fastest.values()), None)
    rows = np.column_stack([first.times, *(t.values for t in fastest.values())]) if first else np.empty((0, 1))
    caption = "Friction of each axle at the higher of its two speeds; lines: fitted course, warm-up included."
    return to_figure(f"friction-{number}", caption, plot, ("days", *fastest), rows)


def _parameter_figure(parameters: Sequence[Trend], number: int) -> Figure:
    columns = 4
    lines = -(-len(parameters) // columns)
    plot, axes = new_plot(height=1.25 * lines + 0.4, rows=lines, columns=columns, sharex=True)
    for axis in axes.flat[len(parameters) :]:
        axis.set_axis_off()
    for axis, trend in zip(axes.flat, parameters, strict=False):
        low, high = trend.values - 2 * trend.deviations, trend.values + 2 * trend.deviations
        axis.fill_between(trend.times, low, high, color=SERIES[0], alpha=0.25, linewidth=0)
        axis.plot(trend.times, trend.values, ".-", color=SERIES[0], markersize=3, linewidth=0.6)
        axis.set_title(f"{trend.name} [{trend.unit}]", fontsize=7, pad=2)
        axis.tick_params(labelsize=5)
    caption = "Parameters with two standard deviations; the abscissa is days since the first of these runs."
    rows = np.column_stack([parameters[0].times, *(trend.values for trend in parameters)])
    return to_figure(f"courses-{number}", caption, plot, ("days", *(trend.name for trend in parameters)), rows)


def _errors(runs: Sequence[PastRun]) -> Section:
    shares = any(run.worst is not None for run in runs)
    known = [run for run in runs if (run.worst if shares else run.worst_torque) is not None]
    shown = known[:: max(1, len(known) // _MOST_POINTS)]
    plot, axes = new_plot(height=2.6)
    number = np.arange(len(shown))
    worst = np.array([run.worst if shares else run.worst_torque for run in shown], dtype=float) * (100 if shares else 1)
    accepted = np.array([run.accepted for run in shown], dtype=bool)
    axes[0, 0].plot(number[accepted], worst[accepted], ".", color=SERIES[2], label="accepted")
    axes[0, 0].plot(number[~accepted], worst[~accepted], "x", color=SERIES[3], label="rejected")
    gates = [run.data["gate"] for run in shown]
    if shares and gates and None not in gates:
        axes[0, 0].plot(number, 100 * np.array(gates), ":", color=SERIES[3], label="gate")
    axes[0, 0].set_ylim(bottom=0)
    axes[0, 0].set_xlabel("run")
    axes[0, 0].set_ylabel("RMSE / nominal torque [%]" if shares else "RMSE [N·m]")
    axes[0, 0].legend(ncols=3)
    rows = np.column_stack([number, worst]) if len(shown) else np.empty((0, 2))
    caption = "Prediction error of the worst axis of every run."
    return Section(
        "Prediction error",
        (),
        (to_figure("errors", caption, plot, ("run", f"worst_{'percent' if shares else 'N·m'}"), rows),),
    )


def _colours(count: int) -> list[str]:
    return [SERIES[k % len(SERIES)] for k in range(count)]
