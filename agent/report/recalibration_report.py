"""The report of one recalibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agent.report.figures import torque_prediction
from agent.report.gap_section import diagnosis_section
from agent.report.page import Page, Section, Table, render


@dataclass(frozen=True, eq=False)
class RecalibrationData:
    """What it shows: the content of `result.json`, the model's table, one stretch of the motion (time (S,), measured,
    predicted and half width of the bounds (S, n)), and sections made elsewhere, in order.
    """

    result: dict[str, Any]
    parameter_rows: Sequence[Sequence[str]]
    prediction: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    sections: Sequence[Section]


def recalibration_report(data: RecalibrationData) -> str:
    """HTML text of the report."""
    result = data.result
    accepted, diagnosis = result["accepted"], result["diagnosis"]
    word = "Accepted, and the current model now" if accepted else f"Rejected: {result['reason']}"
    headline = f"{word}. {diagnosis['summary']}" if diagnosis else f"{word}. {result['comparison']}."
    opening = (diagnosis_section(diagnosis["result"]),) if diagnosis and diagnosis["result"] else ()
    sections = (*opening, _validation(data), *data.sections, _parameters(data), _provenance(result))
    title = f"Recalibration of {result['robot']} {result['serial']}"
    return render(Page(title, headline, "good" if accepted and not diagnosis else "bad", sections))


def _validation(data: RecalibrationData) -> Section:
    validation = data.result["validation"]
    names = tuple(validation["joints"])
    rows = [
        (name, f"{rmse:.3g}", _percent(after), _percent(before), "worse than it was" if name in worse else "")
        for worse in [validation["worse_before"]]
        for name, rmse, after, before in zip(
            names,
            validation["rmse"],
            validation["normalised_rmse"],
            validation["normalised_rmse_before"],
            strict=True,
        )
    ]
    reference = data.result["reference"]
    text = (
        f"The stored loop was run again and {_what(data.result)} estimated; the reference is {reference}.",
        "Errors are on samples that took no part in the fit they judge: stretches left out in turn for the new model, "
        "the whole motion for the one before. Moving samples, over the axis's nominal joint torque.",
    )
    header = ("axis", "new model, RMSE [N·m]", "new model [%]", "model before [%]", "")
    torque = replace(torque_prediction(*data.prediction, names), caption="Torque along one cycle of the loop.")
    parts = (Table("validation", header, rows), torque)
    return Section("Prediction", text, parts)


def _parameters(data: RecalibrationData) -> Section:
    header, *rows = data.parameter_rows
    return Section("Parameters", (), (Table("parameters", header, rows),))


def _provenance(result: dict[str, Any]) -> Section:
    rows = list(result["provenance"].items())
    return Section("Provenance", (), (Table("provenance", ("what", "value"), rows),))


def _what(result: dict[str, Any]) -> str:
    return "friction alone was" if result["parameters"] == "friction" else "all parameters were"


def _percent(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{100 * value:.3f}"
