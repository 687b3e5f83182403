"""The report of one calibration run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.report.common_sections import (
    conditions_section,
    current_sentence,
    diagnosis_part,
    joint_units,
    parameters_section,
    percent,
    provenance_section,
)
from agent.report.figures import motion_box_plot
from agent.report.motion_sections import MotionData, SearchData, motion_section, search_section
from agent.report.page import About, Page, Section, Table, render
from agent.report.torque_section import TorqueData, torque_plot


@dataclass(frozen=True, eq=False)
class RunData:
    """What the report of a run shows.

    result: the content of `result.json`; about: the first screen; parameter_rows: the table of the model, header first;
    motion_rmse (motions, n) [N·m] on moving samples; nominal (n,) torque of the joints, NaN where there is none;
    `prediction` of one unseen motion; `further` sections made elsewhere, in order.
    """

    result: dict[str, Any]
    about: About
    motion: MotionData
    search: SearchData
    parameter_rows: Sequence[Sequence[str]]
    motion_rmse: np.ndarray
    nominal: np.ndarray
    prediction: TorqueData
    further: Sequence[Section] = ()


def run_report(data: RunData) -> str:
    """HTML text of the report."""
    result = data.result
    accepted, diagnosis = result["accepted"] is not False, result["diagnosis"]
    headline = f"{_headline(result)} {current_sentence(result)}".rstrip()
    if diagnosis is not None:
        headline = f"{headline} {diagnosis['summary']}"
    verdict = diagnosis_part(diagnosis, result["reference"])
    notes = result["estimation"]["notes"]
    sections = [
        _validation(data),
        motion_section(data.motion),
        search_section(data.search),
        *data.further,
        conditions_section(result["conditions"], result["validation"]["joints"]),
        parameters_section(data.parameter_rows, notes),
        provenance_section(result),
    ]
    sections.insert(0 if diagnosis is not None else 1, verdict)
    title = f"Calibration of {result['robot']} {result['serial']}".rstrip()
    return render(Page(title, headline, "good" if accepted and diagnosis is None else "bad", sections, data.about))


def _headline(result: dict[str, Any]) -> str:
    validation, gate = result["validation"], result["gate"]
    shares = zip(validation["normalised_rmse"], validation["joints"], strict=True)
    known = [(share, joint) for share, joint in shares if joint not in gate.get("not_judged", [])]
    if not known:
        errors = zip(validation["joints"], validation["rmse"], joint_units(validation), strict=True)
        return (
            "Not judged, as the robot description has no nominal torques. Unseen motions in the sub-region are "
            f"predicted to {', '.join(f'{error:.3g} {unit} on {joint}' for joint, error, unit in errors)}."
        )
    worst, axis = max(known)
    left_out = ", ".join(gate.get("not_judged", []))
    return (
        f"{'Accepted' if result['accepted'] else 'Rejected'}: the worst axis, {axis}, predicts unseen motions in the "
        f"sub-region to {100 * worst:.2f} % of its nominal torque; the gate is {100 * gate['normalised_rmse']:.1f} %."
        f"{f' Not judged, without nominal torque: {left_out}.' if left_out else ''}"
    )


def _validation(data: RunData) -> Section:
    validation, gate = data.result["validation"], data.result["gate"]["normalised_rmse"]
    names, not_judged = tuple(validation["joints"]), data.result["gate"].get("not_judged", [])
    rows = [
        (
            name,
            f"{rmse:.3g}",
            unit,
            percent(moving),
            percent(everything),
            "not judged" if name in not_judged else "" if moving <= gate else "above the gate",
        )
        for name, rmse, unit, moving, everything in zip(
            names,
            validation["rmse"],
            joint_units(validation),
            validation["normalised_rmse"],
            validation["normalised_rmse_all_samples"],
            strict=True,
        )
    ]
    header = ("axis", "RMSE", "unit", "of nominal, moving [%]", "of nominal, all samples [%]", "")
    text = [
        f"{validation['motions']} random motions at {validation['speed']:g} m/s that took no part in the fit.",
        "Normalised: RMSE over the axis's nominal joint torque. Moving samples decide; standstill is shown beside.",
    ]
    if data.result["accepted"] is False:
        text.append(
            "The model of a rejected run is not made current. The residuals below show in which regime it is off; "
            "if they are alike everywhere, more cycles, a longer search or faster motion tell more."
        )
    parts = (
        Table("validation", header, rows),
        motion_box_plot(
            data.motion_rmse,
            data.nominal,
            names,
            gate,
            f"Prediction error on {len(data.motion_rmse)} unseen motions in the sub-region, per axis.",
        ),
        torque_plot(data.prediction, "Torque on one unseen motion, the one in the middle of the field."),
    )
    return Section("Prediction of unseen motions", text, parts)
