"""What the runs of one machine show over the months: error, friction, temperature and parameters on one time axis."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.report.plots import SERIES, Panel, Plot, Series, joint_series

if TYPE_CHECKING:
    from agent.runs import PastRun, Trend, Watch

_MOST_RUNS = 1000
_MOST_PARAMETERS = 24
#: A gate this much above all errors would flatten them.
_GATE_SHOWN = 2.0


def machine_plot(
    one: Watch, parameters: Sequence[Trend], number: int, past: Sequence[PastRun], current: Collection[str]
) -> Plot:
    """Friction, temperature and parameters over the dates of the runs that the trends look at."""
    runs = {run.run: run for run in past}
    chosen = one.trends[0].runs if one.trends else ()
    x = np.array([runs[name].time.timestamp() for name in chosen])
    panels = [_friction(one.trends, current)]
    warmth = _temperatures([runs[name] for name in chosen])
    panels += [warmth] if warmth is not None else []
    for trend in parameters[:_MOST_PARAMETERS]:
        band = Series("two std. dev.", trend.values + 2 * trend.deviations, low=trend.values - 2 * trend.deviations)
        panels.append(Panel(trend.name, trend.unit, (band, Series("value", trend.values, "points"))))
    caption = (
        "Change of each axle's friction at the higher of its two speeds, with the fit of an alarm. Below: "
        "temperatures, if the controller reports them, and parameters. Dates in UTC."
    )
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
    if ordered and (marked := [name in current for name in ordered[0].runs]) and any(marked):
        series.append(Series("current model", np.where(marked, 0.0, np.nan), "points", "#808890"))
    return Panel("change of friction", "%", series)


def _temperatures(runs: Sequence[PastRun]) -> Panel | None:
    """Of the motors at the end of every run; None where no controller tells them."""
    known = [((run.data["conditions"].get("temperatures_c") or {}).get("last")) for run in runs]
    joints = runs[0].data["joints"] if runs else []
    if not any(known) or not joints:
        return None
    lost = [np.nan] * len(joints)
    values = np.array(
        [[np.nan if v is None else v for v in row] if row and len(row) == len(joints) else lost for row in known]
    )
    return Panel("motors at the end of the run", "°C", joint_series(joints, values))


def error_plot(past: Sequence[PastRun], current: Collection[str], robot: str, serial: str, number: int) -> Plot | None:
    """Error of the worst axis of every run of one machine; None where fewer than two runs tell it."""
    runs = [run for run in past if (run.robot, run.serial) == (robot, serial)]
    shares = any(run.worst is not None for run in runs)
    known = [run for run in runs if (run.worst if shares else run.worst_torque) is not None][-_MOST_RUNS:]
    if len(known) < 2:
        return None
    worst = np.array([run.worst if shares else run.worst_torque for run in known], dtype=float) * (100 if shares else 1)
    accepted = np.array([run.accepted for run in known], dtype=bool)
    marked = np.array([run.run in current for run in known], dtype=bool)
    high = ""
    series = [
        Series("accepted", np.where(accepted, worst, np.nan), "points", SERIES[2]),
        Series("rejected", np.where(accepted, np.nan, worst), "points", SERIES[1]),
    ]
    if marked.any():
        series.append(Series("current model", np.where(marked, worst, np.nan), "points", SERIES[0]))
    if shares:
        gates = np.array([np.nan if run.data["gate"] is None else 100 * run.data["gate"] for run in known])
        lowest = np.nanmin(gates, initial=np.inf)
        if lowest <= _GATE_SHOWN * worst.max():
            series.append(Series("gate", gates, "dashed", SERIES[3]))
        elif np.isfinite(lowest):
            high = f" The gate, {lowest:g} %, is above the plot."
    panel = Panel(f"{robot} {serial}".strip(), "% of nominal" if shares else "N·m", series, from_zero=True)
    caption = f"Prediction error of the worst axis of every run of {robot} {serial}".rstrip() + "; dates in UTC." + high
    x = np.array([run.time.timestamp() for run in known])
    return Plot(f"errors-{number}", caption, "date", (panel,), x, dates=True)
