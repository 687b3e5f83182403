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
    parameters_section,
    provenance_section,
)
from agent.report.figures import motion_box_plot, torque_prediction
from agent.report.motion_sections import MotionData, SearchData, motion_section, search_section
from agent.report.page import Page, Section, Table, render


@dataclass(frozen=True, eq=False)
class RunData:
    """What the report of a run shows.

    result: the content of `result.json`; parameter_rows: the table of the model, header first; normalised_rmse
    (motions, n) on moving samples; one unseen motion's time, measured, predicted and half width of the bounds (S, n);
    `further` sections made elsewhere, in order.
    """

    result: dict[str, Any]
    motion: MotionData
    search: SearchData
    parameter_rows: Sequence[Sequence[str]]
    normalised_rmse: np.ndarray
    prediction: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    further: Sequence[Section] = ()


def run_report(data: RunData) -> str:
    """HTML text of the report."""
    result = data.result
    accepted, diagnosis = result["accepted"], result["diagnosis"]
    worst, axis = max(zip(result["validation"]["normalised_rmse"], result["validation"]["joints"], strict=True))
    headline = (
        f"{'Accepted' if accepted else 'Rejected'}: the worst axis, {axis}, predicts unseen motions in the sub-region "
        f"to {100 * worst:.2f} % of its nominal torque; the gate is {100 * result['gate']['normalised_rmse']:.1f} %. "
        f"{current_sentence(result)}"
    )
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
    return render(Page(title, headline, "good" if accepted and diagnosis is None else "bad", sections))


def _validation(data: RunData) -> Section:
    validation, gate = data.result["validation"], data.result["gate"]["normalised_rmse"]
    names = tuple(validation["joints"])
    rows = [
        (
            name,
            f"{rmse:.3g}",
            f"{100 * moving:.3f}",
            f"{100 * everything:.3f}",
            "" if moving <= gate else "above the gate",
        )
        for name, rmse, moving, everything in zip(
            names,
            validation["rmse"],
            validation["normalised_rmse"],
            validation["normalised_rmse_all_samples"],
            strict=True,
        )
    ]
    header = ("axis", "RMSE [N·m]", "of nominal, moving [%]", "of nominal, all samples [%]", "")
    text = [
        f"{validation['motions']} random motions at {validation['speed']:g} m/s that took no part in the fit.",
        "Normalised: RMSE over the axis's nominal joint torque. Moving samples decide; standstill is shown beside.",
    ]
    if not data.result["accepted"]:
        text.append(
            "The model of a rejected run is not made current. The residuals below show in which regime it is off; "
            "if they are alike everywhere, more cycles, a longer search or faster motion tell more."
        )
    parts = (
        Table("validation", header, rows),
        motion_box_plot(
            data.normalised_rmse,
            names,
            gate,
            f"Prediction error on {len(data.normalised_rmse)} unseen motions in the sub-region, per axis.",
        ),
        torque_prediction(*data.prediction, names, "Torque on one unseen motion, the one in the middle of the field."),
    )
    return Section("Prediction of unseen motions", text, parts)
