"""The report of one recalibration."""

from __future__ import annotations

from typing import Any

from agent.report.common_sections import current_sentence, joint_units, percent
from agent.report.figures import motion_box_plot
from agent.report.page import Section, Table
from agent.report.run_page import RunData, render_run
from agent.report.torque_section import torque_plot


def recalibration_report(data: RunData) -> str:
    """HTML text of the report."""
    result = data.result
    word = "Accepted" if result["accepted"] else f"Rejected: {result['reason']}"
    headline = f"{word}. {current_sentence(result)} "
    headline += result["diagnosis"]["summary"] if result["diagnosis"] else f"{result['comparison']}."
    return render_run(data, "Recalibration", headline, _validation(data), _search(result["loop"]))


def _validation(data: RunData) -> Section:
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
        "All errors are held out: stretches left out in turn for the new model, the whole motion for the one before. "
        f"They count moving samples, over the axis's nominal joint torque. The gate is {100 * gate:g} %.",
    )
    header = ("axis", "new model, RMSE", "unit", "new model [%]", "model before [%]", "")
    cycles = f"Error of the new model on each of {len(data.rmse)} cycles, per axis; it was fitted to them."
    parts = (
        Table("validation", header, rows),
        motion_box_plot(data.rmse, data.nominal, names, gate, cycles),
        torque_plot(data.prediction, "Torque along one cycle of the loop."),
    )
    return Section("Prediction", text, parts)


def _search(loop: dict[str, Any]) -> Section:
    text = f"None this time: the stored loop of {loop['created']} was run again, fitness {loop['fitness']:.2f}."
    return Section("Search", (text,))


def _what(result: dict[str, Any]) -> str:
    return "friction alone was" if result["parameters"] == "friction" else "all parameters were"
