"""Sections that every report of a run has: parameters, provenance, and the diagnosis or why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from agent.core import plus_minus
from agent.report.gap_section import diagnosis_section
from agent.report.page import Section, Table

_NORMAL_95 = 1.96
_PRIOR = (
    "Prior: what description and torque level say before the fit. From the data: how much they reduce its variance. "
    "Near 100 % the data determine a parameter, near 0 % the prior does."
)


def current_sentence(result: dict[str, Any]) -> str:
    """Whether the robot's current model is that of this run, or of which other one, when the page was made."""
    current, run = result["current_model"], result["provenance"]["run"]
    if current is None:
        return "The robot has no current model."
    return f"The robot's current model: {'this run' if current == run else f'unchanged (run {current})'}."


def parameters_section(table: Sequence[Sequence[str]], notes: Sequence[str] = ()) -> Section:
    """Every parameter with its 95 % interval; `table` is that of `IdentifiedModel.rows`, header first."""
    _, *rows = table
    priors = any(row[6] != "-" for row in rows)
    shown = [
        (
            name,
            plus_minus(float(value), _NORMAL_95 * float(deviation)),
            unit,
            _known(float(value), float(deviation)),
            *((_with_doubt(mean, doubt), share) if priors else ()),
            meaning,
        )
        for name, value, deviation, _, unit, meaning, mean, doubt, share in rows
    ]
    before = ("prior ± 95 %", "from the data [%]") if priors else ()
    header = ("parameter", "value ± 95 %", "unit", "how well it is known", *before, "stands for")
    text = (*notes, _PRIOR) if priors else notes
    return Section("Parameters", text, (Table("parameters", header, shown),))


def _with_doubt(mean: str, deviation: str) -> str:
    return plus_minus(float(mean), _NORMAL_95 * float(deviation))


def diagnosis_part(diagnosis: dict[str, Any] | None, reference: str) -> Section:
    """What the diagnosis found, or why it did not run. `reference` names the last accepted run, if there is one."""
    if diagnosis is None:
        why = "there is no earlier model to compare with."
        if reference:
            why = f"the model of {reference} predicts the fresh data no worse than it did at its own calibration."
        return Section("Diagnosis", (f"Not needed: {why}",))
    if diagnosis["result"] is None:
        return Section("Diagnosis", (diagnosis["summary"],))
    return diagnosis_section(diagnosis["result"])


def conditions_section(conditions: dict[str, Any], joints: Sequence[str]) -> Section:
    """How warm it was, and how friction changed while the arm moved."""
    rates, rate_stds = (conditions["warm_up"][key] for key in ("rate_per_s", "standard_deviation"))
    temperatures = conditions["temperatures_c"] or {}
    first, last = (temperatures.get(key) or [None] * len(joints) for key in ("first", "last"))
    rows = [
        (joint, _number(rate, 6000, "+.3f"), _number(std, 6000, ".3f"), _number(start), _number(end))
        for joint, rate, std, start, end in zip(joints, rates, rate_stds, first, last, strict=True)
    ]
    text = (
        f"{conditions['cycles']} cycles, {conditions['motion_s']:.0f} s of motion. Friction falls as a cold "
        "arm warms up; the trends correct for that."
        + ("" if temperatures else " No temperatures from this controller."),
    )
    header = ("axis", "friction changes by [%/min]", "std. dev.", "motor at the start [°C]", "at the end [°C]")
    return Section("Conditions", text, (Table("conditions", header, rows),))


def provenance_section(result: dict[str, Any]) -> Section:
    """Versions, and SHA-256 of everything that went into the run."""
    rows = list(result["provenance"].items())
    return Section("Provenance", (), (Table("provenance", ("what", "value"), rows),))


def joint_units(validation: dict[str, Any]) -> list[str]:
    """Unit of each joint's torque; runs of earlier versions do not say it."""
    return validation.get("units") or ["N·m"] * len(validation["joints"])


def percent(share: float | None) -> str:
    """Three decimals of a share, without the sign; "-" where there is none."""
    return _number(share, 100.0, ".3f")


def _number(value: float | None, scale: float = 1.0, form: str = ".1f") -> str:
    return "-" if value is None or not np.isfinite(value) else f"{scale * value:{form}}"


def _known(value: float, deviation: float) -> str:
    """How far a parameter is known: the standard deviation over the value, where that says something."""
    if abs(value) <= _NORMAL_95 * deviation:
        return "may be zero"
    return f"to {100 * deviation / abs(value):.2g} %"
