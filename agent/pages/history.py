"""The page over all runs of a folder: what drifts, every run with its report, and its figures over the months."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Sequence
from urllib.parse import quote

import numpy as np

from agent.core import counted
from agent.pages.elements import About, NextStep, Page, Section, Table, render
from agent.pages.plots import SERIES, Panel, Plot, Series, joint_series
from agent.runs import PastRun, Trend, Watch

_MOST_RUNS = 1000
#: Title of the runs of a kind, and what their error is of: the two cannot be compared.
_KINDS = {
    "calibrate": ("Calibrations", "The error is of motions that took no part in the fit."),
    "recalibrate": ("Recalibrations", "The error is of the repeated loop that the model was fitted to."),
}
_MOST_PARAMETERS = 24
#: A gate this much above all errors would flatten them.
_GATE_SHOWN = 2.0


def index_page(
    runs: Sequence[PastRun], watched: Sequence[Watch], parameters: Sequence[Sequence[Trend]], current: Collection[str]
) -> str:
    """HTML text; links lead to reports in the folders next to the page.

    Runs stand oldest first, trends by machine and program with the course of its `parameters`. `current` names the runs
    that the robots' current models are of.

    Args:
        runs: oldest first.
        watched: trends by machine and program.
        parameters: of each of these, the course of its parameters.
        current: names of runs that current models are of.
    """
    alarms = [(trend, line) for trend in watched for line in trend.lines()]
    machines = sorted({(run.robot, run.serial) for run in runs})
    names = ", ".join(f"{robot} {serial}".strip() for robot, serial in machines)
    too_few = f"{counted(len(runs), 'run')}; trends need at least eight runs of one program."
    if alarms:
        headline, verdict = " · ".join(line for _, line in alarms[:4]), "bad"
    elif watched:
        headline, verdict = "No friction drifts, and no limit is near.", "good"
    else:
        headline, verdict = too_few, "plain"
    errors = [_errors(runs, current, *machine, number) for number, machine in enumerate(machines)]
    plots = [plot for plot in errors if plot is not None]
    sections = [
        *(
            _machine(trend, course, k, runs, current)
            for k, (trend, course) in enumerate(zip(watched, parameters, strict=True))
        ),
        Section("Prediction error", (), plots) if plots else None,
        *(_runs_of(kind, runs, current) for kind in _KINDS if any(run.kind == kind for run in runs)),
        _runs_of("", [run for run in runs if run.kind not in _KINDS], current),
    ]
    return render(Page(f"Calibrations of {names}", headline, verdict, sections, _about(runs, current, alarms)))


def _about(runs: Sequence[PastRun], current: Collection[str], alarms: Sequence[tuple[Watch, str]]) -> About:
    steps = []
    if alarms:
        machine = alarms[0][0]
        serial = f" --serial {shlex.quote(machine.serial)}" if machine.serial else ""
        command = f"agent history --robot {shlex.quote(machine.robot)}{serial} --json"
        steps.append(NextStep("all figures of that machine", command))
    identity = [
        ("runs", f"{len(runs)}, {sum(run.accepted for run in runs)} accepted"),
        ("newest", f"{runs[-1].started[:16].replace('T', ' ')} UTC"),
        ("current models", ", ".join(sorted(current)) or "none"),
    ]
    return About("How are the machines and their models doing?", (), steps, identity)


def _runs_of(kind: str, runs: Sequence[PastRun], current: Collection[str]) -> Section | None:
    """Runs of one kind, or all of these."""
    title, error = _KINDS.get(kind, ("Other runs", ""))
    chosen = [run for run in runs if run.kind == kind or not kind]
    if not chosen:
        return None
    rows, links = [], []
    for run in reversed(chosen):
        cycles = str(run.data["conditions"].get("cycles", "-"))
        outcome = run.outcome_with(current)
        rows.append((run.run, outcome, run.worst_text, run.kind, run.serial or "-", cycles, run.reason))
        links.append(f"{quote(run.run)}/report.html" if run.complete else "")
    accepted = sum(run.accepted for run in chosen)
    text = (f"{counted(len(rows), 'run')}, {accepted} accepted; the newest first.", error)
    header = ("run", "result", "worst axis", "kind", "serial", "cycles", "cause or reason")
    return Section(title, [line for line in text if line], (Table(f"runs-{kind or 'other'}", header, rows, links),))


def _machine(
    watch: Watch, parameters: Sequence[Trend], number: int, runs: Sequence[PastRun], current: Collection[str]
) -> Section:
    text = watch.lines() or ["No drift or step is both significant and of practical size."]
    rows = []
    for trend in sorted(watch.trends, key=lambda trend: (not trend.alarm, trend.probability)):
        change = f"{100 * trend.change:+.2f}" if trend.kind != "none" else ""
        figures = (change, trend.since, f"{trend.probability:.1g}", f"{100 * np.ptp(trend.common):.2f}")
        rows.append((trend.name, trend.kind, *figures, "alarm" if trend.alarm else ""))
    header = ("friction", "course", "change [%]", "after run", "by chance", "warm-up explains [%]", "")
    explained = (
        "All axles share the warm-up. The other axles, and the change of friction within a run, separate it from wear. "
        "By chance: probability that scatter alone causes as much. Alarms use the friction at a speed, as single "
        "parameters are correlated."
    )
    parts: list[Plot | Table] = [_course(watch, parameters, number, runs, current)]
    parts.append(Table(f"friction-trends-{number}", header, rows))
    if parameters:
        parts.append(_parameter_table(parameters, number))
    return Section(f"{watch.robot} {watch.serial}".strip() + ": history of one program", [*text, explained], parts)


def _parameter_table(parameters: Sequence[Trend], number: int) -> Table:
    rows = []
    for trend in parameters:
        change = f"{trend.expected[-1] - trend.expected[0]:+.3g}" if trend.kind != "none" else ""
        latest = (f"{trend.values[-1]:.5g}", f"{trend.deviations[-1]:.2g}")
        rows.append((trend.name, trend.unit, *latest, trend.kind, change, trend.since))
    header = ("parameter", "unit", "latest", "std. dev.", "course", "change", "after run")
    return Table(f"parameters-{number}", header, rows)


def _course(
    watched: Watch, parameters: Sequence[Trend], number: int, runs: Sequence[PastRun], current: Collection[str]
) -> Plot:
    """Friction, temperature and parameters over the dates of the runs that the trends look at."""
    by_name = {run.run: run for run in runs}
    chosen = [by_name[figures.run] for figures in watched.figures]
    panels = [_friction(watched.trends, current), *_temperatures(chosen)]
    for trend in parameters[:_MOST_PARAMETERS]:
        band = Series("two std. dev.", trend.values + 2 * trend.deviations, low=trend.values - 2 * trend.deviations)
        panels.append(Panel(trend.name, trend.unit, (band, Series("value", trend.values, "points"))))
    caption = (
        "Change of each axle's friction at the higher of its two speeds, with the fit of an alarm. Below: "
        "temperatures, if the controller reports them, and parameters. Dates in UTC."
    )
    x = np.array([run.time.timestamp() for run in chosen])
    return Plot(f"history-{number}", caption, "date", panels, x, dates=True, columns=2)


def _friction(trends: Sequence[Trend], current: Collection[str]) -> Panel:
    fastest = {trend.joint: trend for trend in trends}  # the last one of a joint is at its higher speed
    ordered = sorted(fastest.values(), key=lambda trend: (not trend.alarm, trend.probability))
    series = []
    for trend in ordered:
        colour = SERIES[list(fastest).index(trend.joint) % len(SERIES)]
        start = np.median(trend.values[:3])
        values, course = (100 * (part / start - 1) for part in (trend.values, trend.expected))
        series.append(Series(trend.joint, values, "points", colour, joint=trend.joint))
        if trend.alarm:
            series.append(Series(f"{trend.joint}: alarm", course, colour=colour, joint=trend.joint))
    if ordered and (marked := [name in current for name in ordered[0].runs.names]) and any(marked):
        series.append(Series("current model", np.where(marked, 0.0, np.nan), "points", "#808890"))
    return Panel("change of friction", "%", series)


def _temperatures(runs: Sequence[PastRun]) -> list[Panel]:
    """Of the motors at the end of every run; none if no controller reports them."""
    known = [((run.data["conditions"].get("temperatures_c") or {}).get("last")) for run in runs]
    joints = runs[0].data["joints"] if runs else []
    if not any(known) or not joints:
        return []
    lost = [None] * len(joints)
    values = np.array([row if row and len(row) == len(joints) else lost for row in known], dtype=float)
    return [Panel("motors at the end of the run", "°C", joint_series(joints, values))]


def _errors(runs: Sequence[PastRun], current: Collection[str], robot: str, serial: str, number: int) -> Plot | None:
    """Error of the worst axis of every run of one machine; None if fewer than two runs have one."""
    own = [run for run in runs if (run.robot, run.serial) == (robot, serial)]
    shares = any(run.worst is not None for run in own)
    known = [run for run in own if (run.worst if shares else run.worst_torque) is not None][-_MOST_RUNS:]
    if len(known) < 2:
        return None
    worst = np.array([run.worst if shares else run.worst_torque for run in known], dtype=float) * (100 if shares else 1)
    accepted = np.array([run.accepted for run in known], dtype=bool)
    marked = np.array([run.run in current for run in known], dtype=bool)
    caption = f"Prediction error of the worst axis of every run of {robot} {serial}".rstrip() + "; dates in UTC."
    gates = np.array([np.nan if not shares or run.data["gate"] is None else 100 * run.data["gate"] for run in known])
    lowest = np.nanmin(gates, initial=np.inf)
    if _GATE_SHOWN * worst.max() < lowest < np.inf:
        caption += f" The gate, {lowest:g} %, is above the plot."
    panels = []
    for kind in dict.fromkeys([*_KINDS, *(run.kind for run in known)]):
        own_kind = np.array([run.kind == kind for run in known])
        if not own_kind.any():
            continue
        looks = {"accepted": (accepted, SERIES[2]), "rejected": (~accepted, SERIES[1])}
        looks |= {"current model": (marked, SERIES[0])} if (marked & own_kind).any() else {}
        series = [
            Series(name, np.where(mask & own_kind, worst, np.nan), "points", colour)
            for name, (mask, colour) in looks.items()
        ]
        if lowest <= _GATE_SHOWN * worst.max():
            series.append(Series("gate", gates, "dashed", SERIES[3]))
        title = _KINDS.get(kind, (kind, ""))[0]
        panels.append(Panel(title, "% of nominal" if shares else "N·m", series, from_zero=True))
    x = np.array([run.time.timestamp() for run in known])
    return Plot(f"errors-{number}", caption, "date", panels, x, dates=True)
