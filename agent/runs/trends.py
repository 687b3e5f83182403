"""What changes from run to run: wear told from warm-up, step from drift, and how long until a limit.

One series is the friction of an axle at one speed, as runs of the same program found it. With y its logarithm,

    y_r = a + b c_r + change_r + noise,

c is what the other axles' friction did at the same time (their median): warm-up is common to all, wear is not. How
strongly this axle warms, b, is known from within the runs: a cold arm warms up while it moves, the colder the faster,
so b is how its relative rate of change follows the others' from run to run; about 1 (deviation 1) where nothing tells.
Without that, a warm-up that goes along with time could not be told from wear. Arms of fewer axles have the rate itself
in place of c.

What is left is tested as a drift, linear in time or in the number of runs, and as a step after run k. Each is a t-test
against no change (`agent.runs.changes`); alternatives pay for their number, and all series of a machine share
`FALSE_ALARMS` (Bonferroni). An alarm is a change that is no chance and of practical size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.runs.changes import Background, fit_course, line, size_of_change
from agent.runs.past_run import PastParameter, PastRun
from agent.runs.series import FrictionSeries, find_change
from agent.runs.warm_up import FEWEST, common_rate, warm_up_rates

#: Probability of an alarm of any series of a machine without change.
FALSE_ALARMS = 1e-3
#: Relative change of an axle's friction that matters.
PRACTICAL = 0.03
#: How many of the latest runs are looked at.
WINDOW = 40
_DAY = 86_400.0


@dataclass(frozen=True, eq=False)
class Trend:
    """One series over the runs looked at, and what was found in it.

    times (R,) [days since the first], values (R,), deviations (R,); `expected` (R,) is the fitted course. `kind` is
    `none`, `drift` or `step`; `change` is over the whole window (relative for friction) with its `deviation`; `since`
    the run after which a step came; `probability` that chance does as much; `common` the part of the course (R,) that
    warm-up explains.
    """

    name: str
    joint: str
    unit: str
    runs: tuple[str, ...]
    times: np.ndarray
    values: np.ndarray
    deviations: np.ndarray
    expected: np.ndarray
    common: np.ndarray
    kind: str
    change: float
    deviation: float
    probability: float
    since: str
    alarm: bool

    def text(self) -> str:
        """One sentence."""
        if self.kind == "none":
            return f"{self.name}: no change"
        what = f"drifts: {100 * self.change:+.1f} % over {len(self.runs)} runs"
        if self.kind == "step":
            what = f"stepped by {100 * self.change:+.1f} % after {self.since}"
        return f"{self.name} {what} (chance: {self.probability:.1g}); warm-up is taken out"

    def to_dict(self) -> dict[str, Any]:
        """Plain data, without the series."""
        return {
            "name": self.name,
            "joint": self.joint,
            "kind": self.kind,
            "change": self.change,
            "standard_deviation": self.deviation if np.isfinite(self.deviation) else None,
            "probability_by_chance": self.probability,
            "since": self.since or None,
            "alarm": self.alarm,
        }


@dataclass(frozen=True)
class Warning:
    """A limit that comes near: in how many days, or already beyond it (0)."""

    joint: str
    days: float
    text: str


@dataclass(frozen=True, eq=False)
class Watch:
    """What the history of one machine's loop says: friction trends, warnings, and the warm-up covariate (R,) [1/s]."""

    robot: str
    serial: str
    program: str
    trends: tuple[Trend, ...]
    warnings: tuple[Warning, ...]
    warm_up: np.ndarray

    @property
    def alarms(self) -> tuple[Trend, ...]:
        """Trends that are no chance and of practical size; the strongest of each joint."""
        best: dict[str, Trend] = {}
        for trend in self.trends:
            if trend.alarm and (trend.joint not in best or abs(trend.change) > abs(best[trend.joint].change)):
                best[trend.joint] = trend
        return tuple(best.values())

    def lines(self) -> list[str]:
        """Alarms and warnings, a sentence each."""
        return [trend.text() for trend in self.alarms] + [warning.text for warning in self.warnings]

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "robot": self.robot,
            "serial": self.serial,
            "program_sha256": self.program,
            "alarms": [trend.to_dict() for trend in self.alarms],
            "warnings": [{"joint": w.joint, "days": w.days, "text": w.text} for w in self.warnings],
            "trends": [trend.to_dict() for trend in self.trends],
        }


def watch(runs: Sequence[PastRun]) -> list[Watch]:
    """Look at the latest runs of every machine and program; those with too few runs are left out, and so are runs
    dated in the future, whose place in time nobody knows."""
    groups: dict[tuple[str, str, str], list[PastRun]] = {}
    for run in runs:
        if run.complete and run.data["conditions"].get("friction") and not run.in_future():
            groups.setdefault((run.robot, run.serial, run.program), []).append(run)
    return [_watch(key, group[-WINDOW:]) for key, group in groups.items() if len(group) >= FEWEST]


def parameter_trends(
    runs: Sequence[PastRun], parameters: dict[str, list[PastParameter]], joints: dict[str, str] | None = None
) -> list[Trend]:
    """Course of every parameter that all of these runs have; never an alarm, friction levels decide.

    `runs` are of one machine and program, as the trends of a `Watch` are.
    """
    runs = list(runs)[-WINDOW:]
    if len(runs) < FEWEST:
        return []
    tables = [{p.name: p for p in parameters.get(run.run, [])} for run in runs]
    names = [name for name in tables[-1] if all(name in table for table in tables)]
    times, rate = _times(runs), Background(common_rate(*warm_up_rates(runs)))
    found = []
    for name in names:
        values = np.array([table[name].value for table in tables])
        if np.ptp(values) <= 1e-12 * np.abs(values).max():
            continue  # kept from run to run, not estimated
        deviations = np.array([table[name].deviation for table in tables])
        scale = max(float(np.median(np.abs(values))), 1e-300)
        found.append(_trend(name, "", tables[-1][name].unit, runs, times, values, deviations, scale, rate, len(names)))
    return found


def _watch(key: tuple[str, str, str], runs: list[PastRun]) -> Watch:
    robot, serial, program = key
    levels = runs[-1].data["conditions"]["friction"]
    runs = [run for run in runs if len(run.data["conditions"]["friction"]) == len(levels)]
    times, (rates, rate_stds) = _times(runs), warm_up_rates(runs)
    axles = list(runs[-1].data["joints"])
    of_level = tuple(axles.index(level["joint"]) for level in levels)
    series = FrictionSeries(times, of_level, _column(runs, "value"), _column(runs, "from_run_to_run"), rates, rate_stds)
    trends = []
    for k, background in series.backgrounds():
        name = f"friction of {levels[k]['joint']} at {levels[k]['speed']:.2g} rad/s"
        values, deviations = series.values[:, k], series.deviations[:, k]
        found = _trend(name, levels[k]["joint"], "N·m", runs, times, values, deviations, None, background, len(levels))
        trends.append(found)
    warnings = tuple(_warnings(runs, times, trends))
    return Watch(robot, serial, program, tuple(trends), warnings, common_rate(rates, rate_stds))


def _trend(
    name: str,
    joint: str,
    unit: str,
    runs: Sequence[PastRun],
    times: np.ndarray,
    values: np.ndarray,
    deviations: np.ndarray,
    scale: float | None,
    background: Background,
    series: int,
) -> Trend:
    """Test one series (R,) for a drift and for steps, beside what all axles share.

    It is looked at as its logarithm, where `scale` is None, or as a multiple of `scale`.
    """
    y = np.log(values) if scale is None else values / scale
    found = find_change(y, times, background)
    significant = found.probability < FALSE_ALARMS / series
    fit, design = fit_course(y, background, found.shape if significant else None)
    common = design[:, 1] * fit[1] if background.varies else np.zeros(len(y))
    expected = np.exp(design @ fit) if scale is None else design @ fit * scale
    return Trend(
        name=name,
        joint=joint,
        unit=unit,
        runs=tuple(run.run for run in runs),
        times=times,
        values=values,
        deviations=deviations,
        expected=expected,
        common=common,
        kind=found.kind if significant else "none",
        change=float(np.expm1(found.size) if joint else found.size) if significant else 0.0,
        deviation=found.deviation,
        probability=found.probability,
        since=runs[found.place - 1].run if significant and found.kind == "step" else "",
        alarm=bool(joint and significant and abs(found.size) >= PRACTICAL),
    )


def _warnings(runs: Sequence[PastRun], times: np.ndarray, trends: Sequence[Trend]) -> list[Warning]:
    """Drifts that carry an axle's friction, or the prediction error, to the gate within as long as was looked at."""
    found = []
    span = max(float(np.ptp(times)), 1e-9)
    latest = runs[-1].data
    for joint, figures in _errors(runs).items():
        gate = latest["gate"]
        if gate is None or not np.isfinite(figures).all():
            continue
        size, deviation, probability = size_of_change(figures, Background(np.zeros(len(figures))), line(times))
        if size <= 0 or probability * len(latest["joints"]) > FALSE_ALARMS or not np.isfinite(deviation):
            continue
        days = max(0.0, (gate - figures[-3:].mean()) / size * span)
        if days <= span:
            text = f"{joint}: the prediction error grows and reaches the gate of {100 * gate:g} % in {_in(days)}"
            found.append(Warning(joint, days, text))
    for trend in trends:
        nominal = latest["conditions"]["nominal_torque"][latest["joints"].index(trend.joint)]
        if trend.kind != "drift" or not trend.alarm or latest["gate"] is None or nominal is None:
            continue
        limit = latest["gate"] * nominal
        rate = (np.exp(trend.change) - 1) * np.median(trend.values) / span
        gone = trend.expected[-1] - trend.expected[0]
        days = max(0.0, (limit - abs(gone)) / max(abs(rate), 1e-300))
        if days <= span and all(w.joint != trend.joint for w in found):
            text = (
                f"{trend.joint}: friction will have changed by {limit:.3g} N·m, the gate's share of nominal torque, in "
                f"{_in(days)}; a simulation with the first model is then outside the gate"
            )
            found.append(Warning(trend.joint, days, text))
    return found


def _errors(runs: Sequence[PastRun]) -> dict[str, np.ndarray]:
    """Normalised prediction error over the runs (R,), by joint; NaN where a run has none."""
    joints = runs[-1].data["joints"]
    table = [dict(zip(run.data["joints"], run.data["normalised_rmse"], strict=True)) for run in runs]
    values = {joint: [row.get(joint) for row in table] for joint in joints}
    return {joint: np.array([np.nan if v is None else v for v in column]) for joint, column in values.items()}


def _column(runs: Sequence[PastRun], key: str) -> np.ndarray:
    """(R, levels)."""
    return np.array([[level[key] for level in run.data["conditions"]["friction"]] for run in runs], dtype=float)


def _times(runs: Sequence[PastRun]) -> np.ndarray:
    """(R,) days since the first; run numbers where all carry one time."""
    stamps = np.array([run.time.timestamp() for run in runs]) / _DAY
    return stamps - stamps[0] if np.ptp(stamps) > 0 else np.arange(len(runs), dtype=float)


def _in(days: float) -> str:
    if days <= 0:
        return "no time: it is there"
    return f"about {days:.0f} days" if days >= 1 else f"about {24 * days:.1f} hours"
