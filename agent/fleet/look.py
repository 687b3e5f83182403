"""Which machines need a look, in which order, and why: one currency for wear, gaps and runs that failed.

Urgency 1 is the gate of a calibration: an error of so much of nominal torque. A prediction error counts as it is; an
alarm of friction counts with the torque it has changed by, and will have `AHEAD` days from now if it goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.fleet.machines import MachineRuns
from agent.fleet.trends import Course
from agent.recipe import GateSection

#: Normalised RMSE that a calibration is let through with, where its recipe says nothing else.
GATE = float(GateSection.model_fields["normalised_rmse"].default)
#: So far ahead a drift is followed [d].
AHEAD = 90.0
#: Relative change of friction that counts as the gate where a joint has no nominal torque.
_LIKE_GATE = 0.2
_VERDICTS = {
    "explained": "the gap between model and robot is explained",
    "ambiguous": "there is a gap between model and robot, and more than one cause is as good",
    "unknown": "there is a gap between model and robot that nothing known explains",
}


@dataclass(frozen=True, eq=False)
class MachineSummary:
    """A machine as the page shows it: its latest errors (n,), NaN where unknown, and of every run name, day, status,
    reason and page. `failed`: why its latest run, or one nobody knows
    the time of, has no figures; `verdict`, `causes` of its latest diagnosis."""

    robot: str
    joints: tuple[str, ...]
    nominal: np.ndarray
    errors: np.ndarray
    runs: tuple[tuple[str, str, str, str, str | None], ...]
    failed: str
    verdict: str
    causes: str


def see(machine: MachineRuns) -> MachineSummary:
    """What is kept of a machine."""
    known = [entry for entry in machine.figures if entry is not None]
    errors = known[-1]["errors"] if known else np.empty(0)
    n = len(machine.joints)
    rows = zip(machine.runs, machine.status, machine.reason, machine.page, strict=True)
    figures = [k for k, status in enumerate(machine.status) if status == "ok"]
    failed = [
        f"{machine.status[k]}: {machine.reason[k]}"
        for k in range(len(machine.runs))
        if machine.status[k] != "ok" and (not machine.date(k) or not figures or k > figures[-1])
    ]
    runs = tuple((run, machine.date(k), status, reason, page) for k, (run, status, reason, page) in enumerate(rows))
    return MachineSummary(
        machine.robot,
        machine.joints,
        machine.nominal,
        np.array(errors, dtype=float) if len(errors) == n else np.full(n, np.nan),
        runs,
        failed[-1] if failed else "",
        machine.verdict[-1] or "",
        machine.causes[-1],
    )


def urgency(summary: MachineSummary, courses: Sequence[Course]) -> tuple[float, list[str]]:
    """How urgent a look at a machine is, and why; no reason where it is not."""
    weights, reasons = [0.0], []
    for one in courses:
        if one.alarm:
            reasons.append(one.text())
            weights.append(_weight(summary, one))
    worst = [(error, joint) for error, joint in zip(summary.errors, summary.joints, strict=True) if np.isfinite(error)]
    if worst:
        error, joint = max(worst)
        weights.append(float(error) / GATE if error > GATE or reasons else 0.0)
        if error > GATE:
            reasons.append(f"{joint}: error of {100 * error:.1f} % of nominal torque; {100 * GATE:g} % is the gate")
    if summary.verdict in _VERDICTS:
        reasons.append(_VERDICTS[summary.verdict] + (f": {summary.causes}" if summary.causes else ""))
        weights.append(max([0.5, *(float(error) / GATE for error, _ in worst)]))
    if summary.failed:
        reasons.append(f"a run has no figures; {summary.failed}")
        weights.append(1.0)
    return max(weights), reasons


def _weight(summary: MachineSummary, course: Course) -> float:
    if not course.quantity.startswith("friction"):
        return float(course.values[-3:].mean()) / GATE
    days = max(float(course.days[-1] - course.days[0]), 1.0)
    going_on = course.change * AHEAD / days if course.kind == "drift" else 0.0
    change = abs(course.change) + abs(going_on)
    nominal = summary.nominal[summary.joints.index(course.joint)]
    if not np.isfinite(nominal):
        return change / _LIKE_GATE
    return change * float(np.median(course.values)) / (GATE * float(nominal))
