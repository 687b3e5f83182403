"""Changes from run to run: distinguishes wear from warm-up and step from drift, and predicts the time to a limit.

One series is the friction of an axle at one speed, as runs of the same program found it. With y its logarithm,

    y_r = a + b c_r + change_r + noise,

c is what the other axles' friction did at the same time (their median): warm-up is common to all, wear is not. How
strongly this axle warms, b, is known from within the runs: a cold arm warms up while it moves, the colder the faster,
so b is the slope of its relative rate of change over the others' from run to run, with a prior of 1 ± 1. Without that,
warm-up that goes along with time could not be distinguished from wear. Arms with fewer axles use the rate itself
instead of c (`agent.runs.warm_up`).

The rest is tested for a drift, linear in time or in the number of runs, and for a step after run k. Each is a t-test
against no change (`agent.runs.changes`), corrected for the number of alternatives. Here all series of a machine share
`FALSE_ALARMS` (Bonferroni); over a fleet the false discovery rate decides. An alarm is a significant change of
practical size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Any

import numpy as np

from agent.runs.changes import Background, SeriesChange, find_change, fit_course, line, sizes_of_change
from agent.runs.past_run import PastParameter, PastRun
from agent.runs.warm_up import FEWEST, common_rate, warm_up_backgrounds

#: Probability of an alarm of any series of a machine without change.
FALSE_ALARMS = 1e-3
#: Relative change of an axle's friction that matters.
PRACTICAL = 0.03
#: Number of latest runs that are used: more than a year of weeks.
WINDOW = 60
_DAY = 86_400.0


@dataclass(frozen=True)
class RunFigures:
    """What trends follow of one run: prediction errors of every joint as a share of nominal torque; friction and
    warm-up as the conditions of a run hold them. `date` is None where it is unknown."""

    run: str
    date: datetime | None
    joints: Sequence[str]
    errors: Sequence[float | None] = ()
    friction: Sequence[dict[str, Any]] = ()
    warm_up: dict[str, Any] = field(default_factory=dict)


class MachineRuns:
    """Names and dates of R runs of one machine, oldest first, which all its series share."""

    def __init__(self, machine: str, figures: Sequence[RunFigures]):
        self.machine = machine
        self.names = tuple(figure.run for figure in figures)
        self.dates = tuple(figure.date for figure in figures)

    @cached_property
    def days(self) -> np.ndarray:
        """(R,) days since the first; run numbers where not all dates are known, or all are one."""
        known = [date.timestamp() / _DAY for date in self.dates if date is not None]
        if len(known) < len(self.dates) or known[0] == known[-1]:
            return np.arange(len(self.dates), dtype=float)
        return np.array(known) - known[0]


@dataclass(eq=False)
class Trend:
    """One series over R runs, and the likeliest change in it; the caller decides whether it is `significant`.

    Attributes
    ----------
    quantity, at : `friction` of a `joint` at a speed, or the name of a parameter without a joint.
    values, deviations : (R,).
    scale : 0 to test the logarithm, else the values divided by it.
    practical : smallest relative change that matters.
    alternatives : number of series that this one is the likeliest of.
    level : smallest false discovery rate at which the change is a finding, in a fleet.
    """

    runs: MachineRuns
    quantity: str
    joint: str
    unit: str
    values: np.ndarray
    deviations: np.ndarray
    background: Background
    at: str = ""
    scale: float = 0.0
    practical: float = PRACTICAL
    alternatives: int = 1
    significant: bool = False
    level: float = 1.0

    @cached_property
    def found(self) -> SeriesChange:
        """The likeliest change, whether it is significant or not."""
        return find_change(self._looked_at, self.runs.days, self.background)

    @property
    def name(self) -> str:
        """Quantity, joint and speed, in words."""
        return f"{self.quantity} of {self.joint}{self.at}" if self.joint else self.quantity

    @property
    def kind(self) -> str:
        """`none`, `drift` or `step`."""
        return self.found.kind if self.significant else "none"

    @property
    def change(self) -> float:
        """Significant change over the whole window, relative for friction; else 0."""
        return (float(np.expm1(self.found.size)) if self.joint else self.found.size) if self.significant else 0.0

    @property
    def probability(self) -> float:
        """p-value of the likeliest change, corrected for the alternatives."""
        return min(1.0, self.alternatives * self.found.probability)

    @property
    def since(self) -> str:
        """The run after which a step came."""
        return self.runs.names[self.found.place - 1] if self.kind == "step" else ""

    @property
    def alarm(self) -> bool:
        """Whether the change is significant and of practical size."""
        return bool(self.joint and self.significant and abs(self.found.size) >= np.log1p(self.practical))

    @property
    def expected(self) -> np.ndarray:
        """(R,) the fitted course."""
        fit, design = self._course
        return design @ fit * self.scale if self.scale else np.exp(design @ fit)

    @property
    def common(self) -> np.ndarray:
        """(R,) the part of the course that warm-up explains."""
        fit, design = self._course
        return design[:, 1] * fit[1] if self.background.varies else np.zeros(len(self.values))

    @property
    def _looked_at(self) -> np.ndarray:
        return self.values / self.scale if self.scale else np.log(self.values)

    @property
    def _course(self) -> tuple[np.ndarray, np.ndarray]:
        return fit_course(self._looked_at, self.background, self.found.shape if self.significant else None)

    def text(self) -> str:
        """One sentence."""
        if self.kind == "none":
            return f"{self.name}: no change"
        what = f"drifts: {100 * self.change:+.1f} % over {len(self.values)} runs"
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
            "standard_deviation": self.found.deviation if np.isfinite(self.found.deviation) else None,
            "probability_by_chance": self.probability,
            "since": self.since or None,
            "alarm": self.alarm,
        }


@dataclass(frozen=True)
class Warning:
    """A limit that is reached in some days, or is exceeded already (0)."""

    joint: str
    days: float
    text: str


@dataclass(frozen=True, eq=False)
class Watch:
    """Friction trends and warnings from the history of one machine's loop, over the runs with these figures."""

    robot: str
    serial: str
    program: str
    figures: tuple[RunFigures, ...]
    trends: tuple[Trend, ...]
    warnings: tuple[Warning, ...]

    @property
    def alarms(self) -> tuple[Trend, ...]:
        """Significant trends of practical size; the strongest of each joint."""
        alarms = [trend for trend in self.trends if trend.alarm]
        by_size = {trend.joint: trend for trend in sorted(alarms, key=lambda trend: abs(trend.change))}
        return tuple(by_size[joint] for joint in dict.fromkeys(trend.joint for trend in alarms))

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
            "warnings": [dict(vars(warning)) for warning in self.warnings],
            "trends": [trend.to_dict() for trend in self.trends],
        }


def comparable_runs(figures: Sequence[RunFigures], name: str) -> tuple[RunFigures, ...]:
    """The runs with as many figures of a name as the latest; none where they are too few for a trend."""
    comparable = tuple(figure for figure in figures if len(getattr(figure, name)) == len(getattr(figures[-1], name)))
    return comparable if len(comparable) >= FEWEST else ()


def friction_trends(figures: Sequence[RunFigures], machine: str = "") -> list[Trend]:
    """Trends of one machine's friction, a series for every axle and speed, from runs that are alike.

    The caller decides which are significant.
    """
    if not figures or not figures[-1].friction:
        return []
    runs, met = MachineRuns(machine, figures), figures[-1].friction
    axles = [figures[-1].joints.index(level["joint"]) for level in met]
    values, deviations = (
        np.array([[level[key] for level in figure.friction] for figure in figures], dtype=float)
        for key in ("value", "from_run_to_run")
    )
    trends = []
    for k, background in warm_up_backgrounds(axles, values, deviations, *_warm_up_rates(figures)):
        series, at = (values[:, k], deviations[:, k], background), f" at {met[k]['speed']:.2g} rad/s"
        trends.append(Trend(runs, "friction", met[k]["joint"], "N·m", *series, at))
    return trends


def watch(runs: Sequence[PastRun]) -> list[Watch]:
    """Trends over the latest runs of every machine and program with enough runs.

    Runs dated in the future are left out: their real date is unknown.
    """
    groups: dict[tuple[str, str, str], list[PastRun]] = {}
    for run in runs:
        if run.complete and run.data["conditions"].get("friction") and not run.in_future():
            groups.setdefault((run.robot, run.serial, run.program), []).append(run)
    watched = []
    for key, group in groups.items():
        if figures := comparable_runs([_figures(run) for run in group[-WINDOW:]], "friction"):
            trends = friction_trends(figures)
            _decide(trends, len(figures[-1].friction))
            warnings = _warnings(figures, group[-1].data, trends)
            watched.append(Watch(*key, figures, tuple(trends), tuple(warnings)))
    return watched


def parameter_trends(figures: Sequence[RunFigures], parameters: dict[str, list[PastParameter]]) -> list[Trend]:
    """Trends of every parameter that all of these runs, of one machine and program, have; they raise no alarm."""
    tables = [{p.name: p for p in parameters.get(figure.run, [])} for figure in figures]
    names = [name for name in tables[-1] if all(name in table for table in tables)]
    rate, runs = Background(common_rate(*_warm_up_rates(figures))), MachineRuns("", figures)
    trends = []
    for name in names:
        values, deviations = np.array([(table[name].value, table[name].standard_deviation) for table in tables]).T
        if np.ptp(values) <= 1e-12 * np.abs(values).max():
            continue  # kept from run to run, not estimated
        scale = max(float(np.median(np.abs(values))), 1e-300)
        trends.append(Trend(runs, name, "", tables[-1][name].unit, values, deviations, rate, scale=scale))
    _decide(trends, len(names))
    return trends


def _decide(trends: Sequence[Trend], series: int) -> None:
    """Bonferroni over all series of a machine."""
    for trend in trends:
        trend.significant = trend.probability < FALSE_ALARMS / series


def _figures(run: PastRun) -> RunFigures:
    met, data = run.data["conditions"], run.data
    conditions = met.get("friction", ()), met.get("warm_up", {})
    return RunFigures(run.run, run.time, data["joints"], data["normalised_rmse"], *conditions)


def _warm_up_rates(figures: Sequence[RunFigures]) -> list[np.ndarray]:
    """Two arrays (R, n): relative change of friction per second while a run lasted, and its deviation; NaN where
    unknown."""
    axles = len(figures[-1].joints)
    columns = [[figure.warm_up.get(key, []) for figure in figures] for key in ("rate_per_s", "standard_deviation")]
    return [np.array([row if len(row) == axles else [None] * axles for row in rows], dtype=float) for rows in columns]


def _warnings(figures: Sequence[RunFigures], latest: dict[str, Any], trends: Sequence[Trend]) -> list[Warning]:
    """Drifts of the prediction error or of friction that reach the gate within the time span of these runs."""
    gate, days = latest["gate"], MachineRuns("", figures).days
    if gate is None:
        return []
    coming: list[tuple[str, float, float, str]] = []  # joint, margin, change over these runs, text
    for joint, errors in errors_by_joint(figures).items():
        shape, nothing = line(days)[None], Background(np.zeros(len(days)))
        size, deviation, probability = (float(part[0]) for part in sizes_of_change(errors, nothing, shape))
        if size > 0 and probability * len(latest["joints"]) <= FALSE_ALARMS and np.isfinite(deviation):
            text = f"the prediction error grows and reaches the gate of {100 * gate:g} % in {{}}"
            coming.append((joint, gate - errors[-3:].mean(), size, text))
    for trend in trends:
        nominal = latest["conditions"]["nominal_torque"][latest["joints"].index(trend.joint)]
        if trend.kind == "drift" and trend.alarm and nominal is not None:
            limit, course = gate * nominal, trend.expected
            text = (
                f"friction will have changed by {limit:.3g} N·m, the gate's share of nominal torque, in {{}}; a "
                "simulation with the first model is then outside the gate"
            )
            change = abs(trend.change) * float(np.median(trend.values))
            coming.append((trend.joint, limit - abs(course[-1] - course[0]), change, text))
    warnings: dict[str, Warning] = {}
    span = max(float(np.ptp(days)), 1e-9)
    for joint, margin, change, text in coming:
        remaining = max(0.0, float(margin / max(change, 1e-300)) * span)
        if remaining <= span:
            warnings.setdefault(joint, Warning(joint, remaining, f"{joint}: {text.format(_in(remaining))}"))
    return list(warnings.values())


def errors_by_joint(figures: Sequence[RunFigures]) -> dict[str, np.ndarray]:
    """Prediction error over the runs (R,), by joint; NaN where a run has none."""
    table = [dict(zip(figure.joints, figure.errors, strict=False)) for figure in figures]
    return {joint: np.array([row.get(joint) for row in table], dtype=float) for joint in figures[-1].joints}


def _in(days: float) -> str:
    if days <= 0:
        return "no time: it is there"
    return f"about {days:.0f} days" if days >= 1 else f"about {24 * days:.1f} hours"
