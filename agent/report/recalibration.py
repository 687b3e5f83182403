"""The report of one recalibration."""

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
from agent.report.motion_sections import MotionData, motion_section
from agent.report.page import About, Page, Section, Table, render
from agent.report.torque_section import TorqueData, torque_plot


@dataclass(frozen=True, eq=False)
class RecalibrationData:
    """What it shows: the content of `result.json`, the first screen, the loop, the model's table, RMSE (cycles, n)
    [N·m] of every cycle and nominal torque (n,), one stretch of the motion, and sections made elsewhere, in order.
    """

    result: dict[str, Any]
    about: About
    motion: MotionData
    parameter_rows: Sequence[Sequence[str]]
    cycle_rmse: np.ndarray
    nominal: np.ndarray
    prediction: TorqueData
    sections: Sequence[Section]


def recalibration_report(data: RecalibrationData) -> str:
    """HTML text of the report."""
    result = data.result
    accepted, diagnosis = result["accepted"], result["diagnosis"]
    word = "Accepted" if accepted else f"Rejected: {result['reason']}"
    headline = f"{word}. {current_sentence(result)} "
    headline += diagnosis["summary"] if diagnosis else f"{result['comparison']}."
    sections = [
        _validation(data),
        motion_section(data.motion),
        _search(result["loop"]),
        *data.sections,
        conditions_section(result["conditions"], result["validation"]["joints"]),
        parameters_section(data.parameter_rows),
        provenance_section(result),
    ]
    sections.insert(0 if diagnosis else 1, diagnosis_part(diagnosis, result["reference"]))
    title = f"Recalibration of {result['robot']} {result['serial']}"
    return render(Page(title, headline, "good" if accepted and not diagnosis else "bad", sections, data.about))


def _validation(data: RecalibrationData) -> Section:
    validation = data.result["validation"]
    names = tuple(validation["joints"])
    rows = [
        (name, f"{rmse:.3g}", unit, percent(after), percent(before), "worse than it was" if name in worse else "")
        for worse in [validation["worse_before"]]
        for name, rmse, unit, after, before in zip(
            names,
            validation["rmse"],
            joint_units(validation),
            validation["normalised_rmse"],
            validation["normalised_rmse_before"],
            strict=True,
        )
    ]
    reference, gate = data.result["reference"], data.result["gate"]["normalised_rmse"]
    text = (
        f"The stored loop was run again and {_what(data.result)} estimated; the reference is {reference}.",
        "Errors are on samples that took no part in the fit they judge: stretches left out in turn for the new model, "
        f"the whole motion for the one before. Moving samples, over the axis's nominal joint torque; the gate is "
        f"{100 * gate:.1f} %.",
    )
    header = ("axis", "new model, RMSE", "unit", "new model [%]", "model before [%]", "")
    cycles = f"Error of the new model on each of {len(data.cycle_rmse)} cycles, per axis; it was fitted to them."
    parts = (
        Table("validation", header, rows),
        motion_box_plot(data.cycle_rmse, data.nominal, names, gate, cycles),
        torque_plot(data.prediction, "Torque along one cycle of the loop."),
    )
    return Section("Prediction", text, parts)


def _search(loop: dict[str, Any]) -> Section:
    text = f"None this time: the stored loop of {loop['created']} was run again, fitness {loop['fitness']:.2f}."
    return Section("Search", (text,))


def _what(result: dict[str, Any]) -> str:
    return "friction alone was" if result["parameters"] == "friction" else "all parameters were"
