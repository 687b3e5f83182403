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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
#: Number of latest runs that are used.
WINDOW = 40
_DAY = 86_400.0


@dataclass(eq=False)
class Trend:
    """One series over R runs, and the likeliest change in it; the caller sets `significant`.

    `quantity` of a `joint` `at` a speed, or the name of a parameter without a joint; times (R,) [days since the first],
    values (R,), deviations (R,). Tested is the logarithm where `scale` is 0, else the values divided by it. `practical`
    is the smallest size of change that matters.
    """

    quantity: str
    joint: str
    unit: str
    runs: tuple[str, ...]
    times: np.ndarray
    values: np.ndarray
    deviations: np.ndarray
    background: Background
    at: str = ""
    scale: float = 0.0
    practical: float = PRACTICAL
    significant: bool = False

    @cached_property
    def found(self) -> SeriesChange:
        """The likeliest change, whether it is significant or not."""
        return find_change(self._looked_at, self.times, self.background)

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
        """Over the whole window, relative for friction."""
        return (float(np.expm1(self.found.size)) if self.joint else self.found.size) if self.significant else 0.0

    @property
    def probability(self) -> float:
        """p-value of the likeliest change."""
        return self.found.probability

    @property
    def since(self) -> str:
        """The run after which a step came."""
        return self.runs[self.found.place - 1] if self.kind == "step" else ""

    @property
    def alarm(self) -> bool:
        """Whether the change is significant and of practical size."""
        return bool(self.joint and self.significant and abs(self.found.size) >= self.practical)

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
    """Friction trends and warnings from the history of one machine's loop."""

    robot: str
    serial: str
    program: str
    trends: tuple[Trend, ...]
    warnings: tuple[Warning, ...]

    @property
    def alarms(self) -> tuple[Trend, ...]:
        """Significant trends of practical size; the strongest of each joint."""
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


def friction_trends(
    runs: tuple[str, ...],
    times: np.ndarray,
    joints: Sequence[str],
    friction: Sequence[Sequence[dict[str, Any]]],
    warm_up: Sequence[dict[str, Any]],
) -> Iterator[Trend]:
    """Trends of one machine's friction; the caller decides which are significant.

    Parameters
    ----------
    runs, times: names of R runs of one program, and days since the first (R,).
    joints: names of the axles.
    friction, warm_up: what the conditions of every run say of them; each has as many levels of friction as the latest.
    """
    met = friction[-1]
    axles = [joints.index(level["joint"]) for level in met]
    values, deviations = (
        np.array([[level[key] for level in levels] for levels in friction], dtype=float)
        for key in ("value", "from_run_to_run")
    )
    rates = warm_up_rates(warm_up, len(joints))
    for k, background in warm_up_backgrounds(axles, values, deviations, *rates):
        at = f" at {met[k]['speed']:.2g} rad/s"
        yield Trend("friction", met[k]["joint"], "N·m", runs, times, values[:, k], deviations[:, k], background, at)


def warm_up_rates(warm_up: Sequence[dict[str, Any]], axles: int) -> list[np.ndarray]:
    """Two arrays (R, n): relative change of friction per second while a run lasted, and its deviation; NaN where
    unknown."""
    columns = [[one.get(key, []) for one in warm_up] for key in ("rate_per_s", "standard_deviation")]
    return [np.array([row if len(row) == axles else [None] * axles for row in rows], dtype=float) for rows in columns]


def days_since_first(times: Sequence[datetime | None]) -> np.ndarray:
    """(R,) days since the first of the times, in their order; run numbers where not all are known, or all are one."""
    known = [time.timestamp() / _DAY for time in times if time is not None]
    if len(known) < len(times) or not known or known[0] == known[-1]:
        return np.arange(len(times), dtype=float)
    return np.array(known) - known[0]


def watch(runs: Sequence[PastRun]) -> list[Watch]:
    """Trends over the latest runs of every machine and program with enough runs.

    Runs dated in the future are left out: their real date is unknown.
    """
    groups: dict[tuple[str, str, str], list[PastRun]] = {}
    for run in runs:
        if run.complete and run.data["conditions"].get("friction") and not run.in_future():
            groups.setdefault((run.robot, run.serial, run.program), []).append(run)
    return [_watch(key, group[-WINDOW:]) for key, group in groups.items() if len(group) >= FEWEST]


def parameter_trends(runs: Sequence[PastRun], parameters: dict[str, list[PastParameter]]) -> list[Trend]:
    """Trends of every parameter that all of these runs, of one machine and program, have; they raise no alarm."""
    runs = list(runs)[-WINDOW:]
    if len(runs) < FEWEST:
        return []
    tables = [{p.name: p for p in parameters.get(run.run, [])} for run in runs]
    names = [name for name in tables[-1] if all(name in table for table in tables)]
    warm_up = [run.data["conditions"].get("warm_up", {}) for run in runs]
    rate = Background(common_rate(*warm_up_rates(warm_up, len(runs[-1].data["joints"]))))
    times = days_since_first([run.time for run in runs])
    found = []
    for name in names:
        values = np.array([table[name].value for table in tables])
        if np.ptp(values) <= 1e-12 * np.abs(values).max():
            continue  # kept from run to run, not estimated
        deviations = np.array([table[name].deviation for table in tables])
        scale = max(float(np.median(np.abs(values))), 1e-300)
        unit, runs_of = tables[-1][name].unit, tuple(run.run for run in runs)
        found.append(Trend(name, "", unit, runs_of, times, values, deviations, rate, scale=scale))
    _decide(found, len(names))
    return found


def _decide(trends: Sequence[Trend], series: int) -> None:
    """Bonferroni over all series of a machine."""
    for trend in trends:
        trend.significant = trend.probability < FALSE_ALARMS / series


def _watch(key: tuple[str, str, str], runs: list[PastRun]) -> Watch:
    levels = len(runs[-1].data["conditions"]["friction"])
    runs = [run for run in runs if len(run.data["conditions"]["friction"]) == levels]
    names, times = tuple(run.run for run in runs), days_since_first([run.time for run in runs])
    met = [run.data["conditions"] for run in runs]
    friction, warm_up = [one["friction"] for one in met], [one.get("warm_up", {}) for one in met]
    trends = tuple(friction_trends(names, times, runs[-1].data["joints"], friction, warm_up))
    _decide(trends, levels)
    return Watch(*key, trends, tuple(_warnings(runs, times, trends)))


def _warnings(runs: Sequence[PastRun], times: np.ndarray, trends: Sequence[Trend]) -> list[Warning]:
    """Drifts of the prediction error or of friction that reach the gate within the time span of these runs."""
    latest = runs[-1].data
    gate, span = latest["gate"], max(float(np.ptp(times)), 1e-9)
    if gate is None:
        return []
    found = []
    for joint, figures in _errors(runs).items():
        if not np.isfinite(figures).all():
            continue
        shape = line(times)[None]
        (size,), (deviation,), (probability,) = sizes_of_change(figures, Background(np.zeros(len(figures))), shape)
        if size <= 0 or probability * len(latest["joints"]) > FALSE_ALARMS or not np.isfinite(deviation):
            continue
        days = float(max(0.0, (gate - figures[-3:].mean()) / size * span))
        if days <= span:
            text = f"{joint}: the prediction error grows and reaches the gate of {100 * gate:g} % in {_in(days)}"
            found.append(Warning(joint, days, text))
    for trend in trends:
        nominal = latest["conditions"]["nominal_torque"][latest["joints"].index(trend.joint)]
        if trend.kind != "drift" or not trend.alarm or nominal is None:
            continue
        limit = gate * nominal
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
    table = [dict(zip(run.data["joints"], run.data["normalised_rmse"], strict=True)) for run in runs]
    return {joint: np.array([row.get(joint) for row in table], dtype=float) for joint in runs[-1].data["joints"]}


def _in(days: float) -> str:
    if days <= 0:
        return "no time: it is there"
    return f"about {days:.0f} days" if days >= 1 else f"about {24 * days:.1f} hours"
